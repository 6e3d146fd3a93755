//! What of a G-buffer's file belongs into every picture made from it: [`PassThrough`].

use crate::error::PointsError;
use crate::image::{Contents, LayeredImage, Window, contents, read};
use std::fs::File;
use std::path::{Path, PathBuf};

/// Texts of our own, about another picture.
const OWN_TEXTS: &str = "pbgi/";

/// The Cryptomatte layers and the attributes of a G-buffer's file, to go into the picture as they are. The file stays open, so
/// that it need not be there any more when the picture is done; its pixels are read only then.
#[derive(Debug)]
pub struct PassThrough {
    path: PathBuf,
    file: File,
    names: Vec<String>,
}

impl PassThrough {
    /// Looks at a file.
    ///
    /// # Errors
    /// No or a damaged file, or one beyond the limits.
    pub fn open(path: &Path) -> Result<Self, PointsError> {
        let file = File::open(path).map_err(PointsError::io("open", path))?;
        let names = cryptomatte_channels(contents(path, &file)?);
        Ok(Self {
            path: path.to_owned(),
            file,
            names,
        })
    }

    /// Channels that will take memory, 4 bytes a pixel each.
    pub fn channel_count(&self) -> usize {
        self.names.len()
    }

    /// A picture of that window with these channels, and the attributes and cameras of the file.
    ///
    /// # Errors
    /// The file has become unreadable.
    pub fn read(&self, data_window: Window) -> Result<LayeredImage, PointsError> {
        let keep = |name: &str| self.names.iter().any(|kept| kept == name);
        let mut image = read(&self.path, &self.file, Some(data_window), keep)?;
        image.metadata.retain(|key, _| !key.starts_with(OWN_TEXTS));
        Ok(image)
    }
}

/// Channels of the layers that attributes `cryptomatte/.../name` name: their preview (`CryptoObject.R`) and their ranks
/// (`CryptoObject00.R`).
fn cryptomatte_channels(contents: Contents) -> Vec<String> {
    let Contents { mut channels, metadata } = contents;
    let texts = metadata.into_iter();
    let named = texts.filter(|(key, _)| key.starts_with("cryptomatte/") && key.ends_with("/name"));
    let layers: Vec<String> = named.map(|(_, layer)| layer).collect();
    channels.retain(|name| {
        layers.iter().any(|layer| {
            let rest = name.strip_prefix(layer.as_str());
            rest.is_some_and(|rest| rest.trim_start_matches(|c: char| c.is_ascii_digit()).starts_with('.'))
        })
    });
    channels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cryptomatte_layers_are_told_by_the_header() {
        let names = [
            "CryptoObject.R",
            "CryptoObject00.r",
            "CryptoObject01.A",
            "CryptoObjects.R",
            "P.X",
            "R",
        ];
        let contents = Contents {
            channels: names.map(str::to_owned).to_vec(),
            metadata: [
                ("cryptomatte/3cb6acf/name", "CryptoObject"),
                ("cryptomatte/3cb6acf/hash", "P"),
            ]
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .into(),
        };
        assert_eq!(cryptomatte_channels(contents), names[..3]);
    }
}
