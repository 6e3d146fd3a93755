//! The picture from its parts: beauty = albedo / pi (direct + indirect) + emission, everything else in layers.

use super::failure::Failure;
use pbgi_core::Statistics;
use pbgi_points::{GBuffer, LayeredImage, Precision};
use std::f32::consts::FRAC_1_PI;

type Pixels = Vec<[f32; 3]>;

/// Puts a G-buffer and what was shaded for it together.
pub(crate) fn composite(
    gbuffer: &GBuffer,
    shaded: LayeredImage,
    statistics: &Statistics,
) -> Result<LayeredImage, Failure> {
    if shaded.data_window != gbuffer.data_window {
        return Err(Failure::failed(format!(
            "the shaded picture covers {:?}, the G-buffer {:?}",
            shaded.data_window, gbuffer.data_window
        )));
    }
    let missing = || Failure::failed("the shaded picture has no layer \"indirect\"");
    let indirect = shaded.triple("indirect").ok_or_else(missing)?;
    let black = || vec![[0.0; 3]; indirect.len()];
    let albedo = gbuffer.albedo.clone().unwrap_or_else(black);
    let direct = gbuffer.direct.clone().unwrap_or_else(black);
    let emission = gbuffer.emission.clone().unwrap_or_else(black);
    let beauty = beauty(&albedo, &direct, &indirect, &emission);
    // The shaded picture brings indirect, occlusion, bentnormal and A, and the cameras of the G-buffer.
    let mut image = shaded;
    image.add_rgb("", Precision::Half, &beauty);
    image.add_rgb("albedo", Precision::Half, &albedo);
    image.add_rgb("direct", Precision::Half, &direct);
    image.add_rgb("emission", Precision::Half, &emission);
    for row in statistics.rows() {
        if let Some(value) = row.value {
            image.metadata.insert(format!("pbgi/{}", row.name), value.to_string());
        }
    }
    Ok(image)
}

fn beauty(albedo: &Pixels, direct: &Pixels, indirect: &Pixels, emission: &Pixels) -> Pixels {
    let light = direct.iter().zip(indirect);
    let surface = albedo.iter().zip(emission);
    surface
        .zip(light)
        .map(|((albedo, emission), (direct, indirect))| {
            [0, 1, 2].map(|c| albedo[c] * FRAC_1_PI * (direct[c] + indirect[c]) + emission[c])
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_points::Window;
    use std::f32::consts::PI;

    fn one_pixel() -> GBuffer {
        GBuffer {
            data_window: Window::of_size(1, 1),
            display_window: Window::of_size(1, 1),
            world_to_camera: None,
            world_to_ndc: None,
            position: vec![[0.0; 3]],
            normal: vec![[0.0, 0.0, 1.0]],
            coverage: vec![1.0],
            albedo: Some(vec![[0.5, 0.25, 1.0]]),
            direct: Some(vec![[PI, PI, 0.0]]),
            emission: Some(vec![[0.0, 0.0, 3.0]]),
        }
    }

    #[test]
    fn beauty_is_reflected_light_and_emission() {
        let mut shaded = LayeredImage::new(1, 1);
        shaded.add_rgb("indirect", Precision::Half, &[[PI, 0.0, 0.0]]);
        shaded.add("occlusion.Z", Precision::Half, vec![0.5]);
        let statistics = Statistics {
            points: Some(7.0),
            ..Default::default()
        };
        let image = composite(&one_pixel(), shaded, &statistics).unwrap();
        let root = image.triple("").unwrap()[0];
        for (value, expected) in root.iter().zip([1.0, 0.25, 3.0]) {
            assert!((value - expected).abs() < 1e-6, "{root:?}");
        }
        for name in ["indirect.R", "occlusion.Z", "albedo.G", "direct.B", "emission.B"] {
            assert!(image.channel(name).is_some(), "{name}");
        }
        assert_eq!(image.metadata["pbgi/points"], "7");
    }

    #[test]
    fn pictures_of_different_shapes_are_refused() {
        let text = composite(&one_pixel(), LayeredImage::new(2, 1), &Statistics::default())
            .unwrap_err()
            .to_string();
        assert!(text.contains("covers"), "{text}");
    }
}
