//! Pictures for people: a PNG file beside the EXR file, a preview in the terminal.

use super::answer::note;
use super::failure::Failure;
use super::files::{self, Existing};
use clap::Args;
use pbgi_points::image::tone_mapped;
use pbgi_points::{ToneMap, Window, write_png};
use std::path::PathBuf;

/// How a picture is shown.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Picture to look at")]
pub(crate) struct LookArgs {
    /// Also write a tone-mapped picture to look at
    #[arg(long, value_name = "FILE.png")]
    png: Option<PathBuf>,
    #[command(flatten)]
    exposure: ExposureArgs,
}

/// The same, for a command that writes a PNG file anyway.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Picture to look at")]
pub(crate) struct ExposureArgs {
    /// Stops by which it is brightened; at 0, radiance 1 is just below white [default: chosen for each picture]
    #[arg(long, allow_negative_numbers = true, value_name = "STOPS", value_parser = stops)]
    exposure: Option<f32>,
    /// Show the picture in the terminal, too
    #[arg(long)]
    preview: bool,
}

fn stops(text: &str) -> Result<f32, String> {
    const MOST: f32 = 60.0;
    match text.parse::<f32>() {
        Ok(value) if value.abs() <= MOST => Ok(value),
        _ => Err(format!("it must be a number from -{MOST} to {MOST}")),
    }
}

/// What was asked for, checked before any work is done.
#[derive(Clone, Debug)]
pub(crate) struct Look {
    png: Option<PathBuf>,
    tone_map: ToneMap,
    preview: bool,
}

impl LookArgs {
    pub(crate) fn check(&self, existing: Existing) -> Result<Look, Failure> {
        let png = self.png.as_deref();
        let png = png
            .map(|path| files::output_of_kind(path, existing, "png"))
            .transpose()?;
        Ok(self.exposure.look(png))
    }
}

impl ExposureArgs {
    /// For pictures of colours that are to stay as they are: radiance 1 is white at 0 stops.
    pub(crate) fn look_of_colours(&self, png: PathBuf) -> Look {
        Look {
            png: Some(png),
            tone_map: ToneMap::Exposure(self.exposure.unwrap_or(0.0).exp2()),
            preview: self.preview,
        }
    }

    pub(crate) fn look(&self, png: Option<PathBuf>) -> Look {
        Look {
            png,
            tone_map: self.exposure.map_or(ToneMap::Filmic, ToneMap::Stops),
            preview: self.preview,
        }
    }
}

impl Look {
    /// Whether there is anything to show.
    pub(crate) fn wanted(&self) -> bool {
        self.preview || self.png.is_some()
    }

    /// Shows radiance.
    pub(crate) fn show(&self, window: Window, pixels: &[[f32; 3]]) -> Result<(), Failure> {
        if let Some(path) = &self.png {
            write_png(path, window.width, window.height, pixels, self.tone_map)?;
            note(format_args!("wrote {}", path.display()));
        }
        if self.preview {
            preview(window, &tone_mapped(pixels, self.tone_map))?;
        }
        Ok(())
    }
}

/// Draws a picture of three bytes a pixel into the terminal.
fn preview(window: Window, bytes: &[u8]) -> Result<(), Failure> {
    let terminal = console::Term::stdout();
    if !terminal.is_term() {
        note(format_args!("no preview: the output is no terminal"));
        return Ok(());
    }
    let (_, columns) = terminal.size();
    let drawn = terminal.write_str(&blocks(window, bytes, u32::from(columns)));
    drawn.map_err(|error| Failure::failed(format!("cannot draw the picture: {error}")))
}

/// Half blocks, two pixels to a character: the upper one in front, the lower one behind it, each the mean of those it stands
/// for.
fn blocks(window: Window, bytes: &[u8], columns_max: u32) -> String {
    let columns = window.width.min(columns_max).max(1);
    let rows = (u64::from(window.height) * u64::from(columns) / u64::from(window.width.max(1))).max(1) as u32;
    let pixel = |column: u32, row: u32| {
        let span = |index: u32, count: u32, length: u32| {
            let edge = |index: u32| (u64::from(index) * u64::from(length) / u64::from(count)) as usize;
            edge(index)..edge(index + 1).max(edge(index) + 1)
        };
        let (mut sum, mut count) = ([0u32; 3], 0);
        for y in span(row, rows, window.height) {
            for x in span(column, columns, window.width) {
                let start = (y * window.width as usize + x) * 3;
                let Some(rgb) = bytes.get(start..start + 3) else {
                    continue;
                };
                sum.iter_mut().zip(rgb).for_each(|(sum, &byte)| *sum += u32::from(byte));
                count += 1;
            }
        }
        let [r, g, b] = sum.map(|sum| sum.checked_div(count).unwrap_or(0));
        format!("{r};{g};{b}")
    };
    let mut text = String::new();
    for row in (0..rows).step_by(2) {
        for column in 0..columns {
            text += &format!("\x1b[38;2;{}m", pixel(column, row));
            if row + 1 < rows {
                text += &format!("\x1b[48;2;{}m", pixel(column, row + 1));
            }
            text.push('\u{2580}');
        }
        text += "\x1b[0m\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_pixels_make_a_character() {
        let bytes = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 9, 9], [7, 7, 7], [5, 5, 5]].concat();
        let text = blocks(Window::of_size(2, 3), &bytes, 80);
        let expected = "\x1b[38;2;255;0;0m\x1b[48;2;0;0;255m\u{2580}\x1b[38;2;0;255;0m\x1b[48;2;9;9;9m\u{2580}\x1b[0m\n\
            \x1b[38;2;7;7;7m\u{2580}\x1b[38;2;5;5;5m\u{2580}\x1b[0m\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn a_preview_fits_the_terminal() {
        let bytes = [200, 100, 0].repeat(640 * 360);
        let text = blocks(Window::of_size(640, 360), &bytes, 80);
        assert_eq!(text.lines().count(), 23);
        assert!(text.lines().all(|line| line.matches('\u{2580}').count() == 80));
        assert!(text.contains("38;2;200;100;0m") && text.contains("48;2;200;100;0m"));
    }
}
