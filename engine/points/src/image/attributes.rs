//! What an EXR file says beside its pixels and texts, kept as it is: [`Attributes`].

use exr::meta::attribute::{AttributeValue, IntegerBounds};
use exr::meta::header::{Header, ImageAttributes, LayerAttributes};
use std::collections::BTreeMap;

/// Everything in the header of an EXR file for which [`super::LayeredImage`] has no field of its own: owner, chromaticities,
/// time code, lens, and whatever other programs left there. A file that is written with it has it again.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Attributes(Option<Box<Kept>>);

#[derive(Clone, Debug, PartialEq)]
struct Kept {
    image: ImageAttributes,
    layer: LayerAttributes,
}

impl Attributes {
    /// Takes those of all parts, earlier parts first, and apart from them the texts.
    pub(super) fn of(headers: &[Header]) -> (Self, BTreeMap<String, String>) {
        let mut texts = BTreeMap::new();
        let Some(first) = headers.first() else {
            return (Self::default(), texts);
        };
        let mut kept = Kept {
            image: first.shared_attributes.clone(),
            layer: LayerAttributes {
                // What belongs to the parts of that file, or is the caller's business.
                layer_name: None,
                layer_position: LayerAttributes::default().layer_position,
                view_name: None,
                multi_view_names: None,
                deep_image_state: None,
                preview: None,
                software_name: None,
                world_to_camera: None,
                world_to_normalized_device: None,
                ..first.own_attributes.clone()
            },
        };
        kept.image.other.clear();
        kept.layer.other.clear();
        for header in headers {
            let lists = [
                (&header.shared_attributes.other, &mut kept.image.other),
                (&header.own_attributes.other, &mut kept.layer.other),
            ];
            for (list, kept) in lists {
                for (key, value) in list {
                    if let AttributeValue::Text(text) = value {
                        texts.entry(key.to_string()).or_insert_with(|| text.to_string());
                    } else {
                        kept.entry(key.clone()).or_insert_with(|| value.clone());
                    }
                }
            }
        }
        (Self(Some(Box::new(kept))), texts)
    }

    /// For a file that is to be written.
    pub(super) fn for_file(&self, display_window: IntegerBounds) -> (ImageAttributes, LayerAttributes) {
        match &self.0 {
            Some(kept) => {
                let image = ImageAttributes {
                    display_window,
                    ..kept.image.clone()
                };
                (image, kept.layer.clone())
            }
            None => (ImageAttributes::new(display_window), LayerAttributes::default()),
        }
    }
}
