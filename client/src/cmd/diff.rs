//! `diff`: how far two pictures are apart.

use super::answer::{note, say};
use super::failure::Failure;
use super::files::{self, Existing};
use super::interrupt::Interrupt;
use clap::Args;
use pbgi_points::image::{SHARE_LEVELS, write_heat_png};
use pbgi_points::{Difference, LayerDifference, LayeredImage};
use serde::Serialize;
use std::path::{Path, PathBuf};

const NOTES: &str = "\
Examples:
  pbgi-client diff new.exr reference.exr
  pbgi-client diff new.exr reference.exr --layer indirect --threshold 0.01 -o heat.png

Differences are those of the second picture, the reference, over the pixels that both data windows have. rms is the root of the
mean square over a layer's samples, relative that divided by the mean of the reference's absolute values; maximum is the largest
difference of one sample, and at its pixel; the last columns are the shares of pixels with a difference above that.
Exit codes: 0 compared, and within the threshold; 1 a layer's rms is above it, or pixels or channels that only one picture has were
found; 2 the files cannot be compared. Without --threshold, 0 or 2.";

/// `diff`
#[derive(Args, Debug)]
#[command(after_help = NOTES)]
pub(crate) struct DiffArgs {
    /// A picture
    #[arg(value_name = "A.exr")]
    first: PathBuf,
    /// The one that it is compared with
    #[arg(value_name = "B.exr")]
    second: PathBuf,
    /// Compare this layer only; may be repeated; "" is the root [default: all that both have]
    #[arg(long = "layer", value_name = "NAME")]
    layers: Vec<String>,
    /// Fail if the rms of a layer is above this
    #[arg(long, allow_negative_numbers = true, value_name = "RMS", value_parser = bound)]
    threshold: Option<f64>,
    /// Write a heat map of the first layer that is compared (the root, unless --layer says otherwise)
    #[arg(short, long, value_name = "HEAT.png")]
    output: Option<PathBuf>,
    /// Difference that is shown brightest in the heat map [default: the layer's largest]
    #[arg(long, allow_negative_numbers = true, value_name = "D", value_parser = super::args::positive, requires = "output")]
    range: Option<f32>,
    /// Replace an existing output
    #[arg(long)]
    overwrite: bool,
    /// Print one JSON object instead of the table
    #[arg(long)]
    json: bool,
}

fn bound(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value >= 0.0 && value.is_finite() => Ok(value),
        _ => Err("it must be a number, 0 or above".to_owned()),
    }
}

/// What `--json` prints.
#[derive(Serialize)]
struct Report<'a> {
    first: &'a Path,
    second: &'a Path,
    #[serde(flatten)]
    difference: &'a Difference,
    share_levels: [f32; 3],
    threshold: Option<f64>,
    within_threshold: Option<bool>,
}

pub(crate) async fn diff(args: DiffArgs, interrupt: &Interrupt) -> Result<(), Failure> {
    // 1 says that the pictures differ, so it cannot say that they were not compared.
    let trouble = |failure: Failure| match failure {
        Failure::Failed(text) => Failure::Usage(text),
        other => other,
    };
    let within = interrupt.blocking(move || run(&args)).await.map_err(trouble)?;
    match within {
        true => Ok(()),
        false => Err(Failure::failed("the pictures differ by more than the threshold")),
    }
}

/// Compares and tells; whether the pictures are within the threshold.
fn run(args: &DiffArgs) -> Result<bool, Failure> {
    let heat = args.output.as_deref();
    let heat = heat.map(|path| files::output_of_kind(path, Existing::from_flag(args.overwrite), "png"));
    let heat = heat.transpose()?;
    let wanted = |name: &str| args.layers.is_empty() || args.layers.iter().any(|layer| layer == layer_of(name));
    let read = |path: &Path| Ok::<_, Failure>(LayeredImage::read_exr_channels(&files::input(path)?, wanted)?);
    let (first, second) = (read(&args.first)?, read(&args.second)?);
    let mut difference = Difference::between(&first, &second).ok_or_else(|| {
        let (a, b) = (first.data_window, second.data_window);
        Failure::failed(format!("the pictures have no pixel in common: {a:?} and {b:?}"))
    })?;
    // In the order in which they were asked for: the first is the one of the heat map.
    let place = |layer: &LayerDifference| args.layers.iter().position(|name| *name == layer.layer);
    difference.layers.sort_by_key(place);
    if let Some(missing) = args
        .layers
        .iter()
        .find(|name| !difference.layers.iter().any(|layer| layer.layer == **name))
    {
        return Err(Failure::failed(format!("layer {missing:?} is not in both pictures")));
    }
    let Some(shown) = difference.layers.first() else {
        return Err(Failure::failed("the pictures have no layer in common"));
    };
    if let Some(path) = &heat {
        let most = args.range.unwrap_or(shown.maximum).max(f32::MIN_POSITIVE);
        let window = difference.window;
        write_heat_png(path, window.width, window.height, &shown.map, most)?;
        let name = shown_name(&shown.layer);
        note(format_args!(
            "wrote {}: {name}, black 0 to pale yellow {most}",
            path.display()
        ));
    }
    let within = args.threshold.map(|threshold| fits(&difference, threshold));
    if args.json {
        let report = Report {
            first: &args.first,
            second: &args.second,
            difference: &difference,
            share_levels: SHARE_LEVELS,
            threshold: args.threshold,
            within_threshold: within,
        };
        say(&super::summary::pretty(&report))?;
    } else {
        say(&table(&difference))?;
    }
    Ok(within.unwrap_or(true))
}

fn layer_of(channel: &str) -> &str {
    channel.rsplit_once('.').map_or("", |(layer, _)| layer)
}

fn fits(difference: &Difference, threshold: f64) -> bool {
    let alike = difference.only_first.is_empty() && difference.only_second.is_empty();
    let near = |layer: &LayerDifference| layer.rms <= threshold && layer.not_comparable == 0;
    alike && difference.layers.iter().all(near)
}

fn shown_name(layer: &str) -> &str {
    if layer.is_empty() { "(root)" } else { layer }
}

fn table(difference: &Difference) -> String {
    let names = difference.layers.iter().map(|layer| shown_name(&layer.layer).len());
    let width = names.max().unwrap_or(0).max("layer".len());
    let levels: String = SHARE_LEVELS
        .iter()
        .map(|level| format!("  {:>8}", format!("> {level}")))
        .collect();
    let mut text = format!(
        "{:width$}  {:>10}  {:>9}  {:>10}  {:>12}{levels}\n",
        "layer", "rms", "relative", "maximum", "at"
    );
    for layer in &difference.layers {
        let percent = |share: f64| format!("{:.2} %", share * 100.0);
        let relative = layer.relative_rms.map_or_else(|| "-".to_owned(), percent);
        let [x, y] = layer.maximum_at;
        let shares: String = layer
            .shares
            .iter()
            .map(|&share| format!("  {:>8}", percent(share)))
            .collect();
        text += &format!(
            "{:width$}  {:>10.3e}  {relative:>9}  {:>10.3e}  {:>12}{shares}\n",
            shown_name(&layer.layer),
            layer.rms,
            layer.maximum,
            format!("{x}, {y}")
        );
        if layer.not_comparable > 0 {
            let count = super::summary::grouped(layer.not_comparable);
            text += &format!("{:width$}  {count} pixels are finite in one picture only\n", "");
        }
    }
    for (which, channels) in [("first", &difference.only_first), ("second", &difference.only_second)] {
        if !channels.is_empty() {
            text += &format!("only the {which} picture has {}\n", channels.join(", "));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_points::Precision;

    fn image(value: f32) -> LayeredImage {
        let mut image = LayeredImage::new(2, 2);
        image.add_rgb("", Precision::Float, &[[1.0; 3]; 4]);
        image.add("occlusion.Z", Precision::Float, vec![value, 0.5, 0.5, 0.5]);
        image
    }

    #[test]
    fn a_threshold_is_on_every_layer_and_on_what_only_one_has() {
        let compare = |a: &LayeredImage, b: &LayeredImage| Difference::between(a, b).unwrap();
        let near = compare(&image(0.5), &image(0.52));
        assert!(fits(&near, 0.0101) && !fits(&near, 0.0099));
        assert!(!fits(&compare(&image(0.5), &image(f32::NAN)), 1.0));
        let mut more = image(0.5);
        more.add("A", Precision::Half, vec![1.0; 4]);
        assert!(!fits(&compare(&more, &image(0.5)), 1.0));
        let text = table(&compare(&more, &image(0.6)));
        assert!(text.contains("(root)") && text.contains("occlusion"), "{text}");
        assert!(
            text.contains("5.000e-2") && text.contains("25.00 %") && text.contains("0, 0"),
            "{text}"
        );
        assert!(text.contains("only the first picture has A"), "{text}");
    }
}
