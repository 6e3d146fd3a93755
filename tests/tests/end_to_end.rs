//! What a user gets from the command line: pictures, statistics, and a cache that is shared.

use pbgi_core::Statistics;
use pbgi_points::LayeredImage;
use pbgi_tests::{DAEMON, House, Picture, SHADED, assert_same, assert_same_values, page_count, rms};

#[test]
fn render_and_the_single_steps_give_the_same_picture() {
    let house = House::new();
    house.furnish(60_000, "64x64");
    house
        .line(&format!("build demo.glb -o mesh.pbgi --points 60000 {DAEMON}"))
        .ok();
    for (scene, picture) in [("mesh.pbgi", "steps.exr"), ("demo.pbgi", "cloud.exr")] {
        house
            .line(&format!("shade {scene} --gbuffer g.exr -o {picture} {DAEMON}"))
            .ok();
    }
    house
        .line(&format!(
            "render demo.glb -o render.exr --points 60000 --size 64x64 --png render.png --stats r.json {DAEMON}"
        ))
        .ok();
    let (steps, render) = (
        Picture::read(&house.path("steps.exr")),
        Picture::read(&house.path("render.exr")),
    );
    for layer in SHADED.into_iter().chain(["A"]) {
        assert_same_values(layer, steps.channel(layer), render.channel(layer));
    }
    // By way of a point file the picture is close, not the same to the last bit.
    let cloud = Picture::read(&house.path("cloud.exr"));
    for (layer, most) in [("occlusion.Z", 0.01), ("indirect.G", 0.02)] {
        let off = rms(cloud.channel(layer), render.channel(layer), render.channel("A"));
        assert!(off < most, "{layer} is off by {off}");
    }
    // The root is beauty = albedo / pi (direct + indirect) + emission, in half precision.
    for colour in ["R", "G", "B"] {
        let part = |name: &str| render.channel(&format!("{name}.{colour}"));
        let (albedo, direct, indirect, emission) = (part("albedo"), part("direct"), part("indirect"), part("emission"));
        for (pixel, &beauty) in render.channel(colour).iter().enumerate() {
            let light = direct[pixel] + indirect[pixel];
            let expected = albedo[pixel] / std::f32::consts::PI * light + emission[pixel];
            assert!(
                (beauty - expected).abs() <= 2e-3 * expected.abs() + 1e-4,
                "{beauty} {expected}"
            );
        }
    }
    assert_eq!(
        &std::fs::read(house.path("render.png")).unwrap()[..8],
        b"\x89PNG\r\n\x1a\n"
    );
    // One command, one record: of the build and of the shading.
    let statistics = house.statistics("r.json");
    for name in ["points", "build_seconds", "shading_seconds", "shading_calls"] {
        assert!(statistics[name].as_f64().unwrap() > 0.0, "{name}");
    }
}

#[test]
fn second_shade_reads_no_page_from_disk() {
    let house = House::new();
    house.furnish(60_000, "64x64");
    for run in ["cold", "warm"] {
        house
            .line(&format!(
                "shade demo.pbgi --gbuffer g.exr -o {run}.exr --stats {run}.json {DAEMON}"
            ))
            .ok();
    }
    assert_eq!(house.running("pbgi-server").len(), 1);
    assert_same(
        &Picture::read(&house.path("cold.exr")),
        &Picture::read(&house.path("warm.exr")),
    );
    assert!(house.statistics("cold.json")["pages_loaded"].as_u64().unwrap() > 10);
    let warm = house.statistics("warm.json");
    for name in [
        "pages_loaded",
        "bytes_read",
        "cache_misses",
        "redundant_reads",
        "reloads",
    ] {
        assert_eq!(warm[name], 0, "{name}: {warm:#}");
    }
    assert_eq!(warm["cache_hit_ratio"], 1);
    assert_eq!(warm["cache_io_ratio"], 0);
}

#[test]
fn two_shades_at_once_share_their_pages() {
    let house = House::new();
    house.furnish(60_000, "96x64");
    let shade = |run: &str| {
        house.start(&format!(
            "shade demo.pbgi --gbuffer g.exr -o {run}.exr --stats {run}.json {DAEMON}"
        ))
    };
    let (a, b) = (shade("a"), shade("b"));
    a.end().ok();
    b.end().ok();
    assert_same(
        &Picture::read(&house.path("a.exr")),
        &Picture::read(&house.path("b.exr")),
    );
    let statistics = ["a.json", "b.json"].map(|name| house.statistics(name));
    let sum = |name: &str| statistics.iter().map(|one| one[name].as_u64().unwrap()).sum::<u64>();
    let pages = page_count(&house.path("demo.pbgi"));
    assert!(sum("pages_loaded") <= pages, "{statistics:#?} {pages}");
    assert_eq!(sum("redundant_reads"), 0);
    assert_eq!(sum("reloads"), 0);
}

#[test]
fn output_has_all_channels_and_says_how_it_was_made() {
    let house = House::new();
    house.furnish(20_000, "96x64");
    house
        .line(&format!(
            "shade demo.pbgi --gbuffer g.exr -o out.exr --max-dist 0.75 --stats out.json {DAEMON}"
        ))
        .ok();
    let picture = Picture::read(&house.path("out.exr"));
    assert_eq!((picture.width, picture.height), (96, 64));
    let names: Vec<&str> = picture.channels.keys().map(String::as_str).collect();
    let mut expected = SHADED.to_vec();
    expected.extend(["A", "R", "G", "B"]);
    expected.sort_unstable();
    assert_eq!(names, expected);
    for colour in ["R", "G", "B"] {
        assert_eq!(picture.channel(colour), picture.channel(&format!("indirect.{colour}")));
    }
    let image = LayeredImage::read_exr(&house.path("out.exr")).unwrap();
    assert_eq!(image.metadata["pbgi/scene"], "demo.pbgi");
    assert_eq!(image.metadata["pbgi/max_dist"], "0.75");
    let statistics = house.statistics("out.json");
    for name in ["points", "nodes", "holes", "shading_calls"] {
        assert_eq!(image.metadata[&format!("pbgi/{name}")], statistics[name].to_string());
    }
    // The camera looks past the room at both sides.
    let alpha = picture.channel("A");
    let holes = alpha.iter().filter(|&&alpha| alpha == 0.0).count();
    assert!(holes > 1_000);
    assert_eq!(statistics["holes"], holes);
    assert_eq!(statistics["shading_calls"], 96 * 64 - holes);
    for (name, values) in &picture.channels {
        assert!(values.iter().all(|value| value.is_finite()), "{name}");
        let in_holes = values.iter().zip(alpha).filter(|(_, alpha)| **alpha == 0.0);
        assert!(in_holes.into_iter().all(|(value, _)| *value == 0.0), "{name}");
    }
    let occlusion = picture.channel("occlusion.Z");
    assert!(occlusion.iter().all(|value| (0.0..=1.0).contains(value)));
    assert!(occlusion.iter().any(|&value| value > 0.2));
    let bent = ["X", "Y", "Z"].map(|axis| picture.channel(&format!("bentnormal.{axis}")));
    let length = |pixel: usize| bent.map(|axis| axis[pixel].powi(2)).iter().sum::<f32>().sqrt();
    assert!((0..alpha.len()).all(|pixel| length(pixel) < 1.001));
}

#[test]
fn statistics_have_every_name_and_numbers_that_fit_together() {
    let house = House::new();
    house.furnish(60_000, "64x64");
    house
        .line(&format!("build demo.ply -o again.pbgi --stats build.json {DAEMON}"))
        .ok();
    house
        .line(&format!(
            "shade again.pbgi --gbuffer g.exr -o out.exr --stats shade.json {DAEMON}"
        ))
        .ok();
    house
        .line("gbuffer demo.glb -o h.exr --size 16x16 --stats gbuffer.json")
        .ok();
    for file in ["build.json", "shade.json", "gbuffer.json"] {
        let object = house.statistics(file).as_object().unwrap().clone();
        let rows = Statistics::default().rows();
        assert_eq!(object.len(), rows.len(), "{file}");
        for row in rows {
            let value = object.get(row.name).unwrap_or_else(|| panic!("{file}: {}", row.name));
            let fits = value.is_null() || value.as_f64().is_some_and(|value| value >= 0.0);
            assert!(fits, "{file}: {} is {value}", row.name);
        }
    }
    let (build, shade) = (house.statistics("build.json"), house.statistics("shade.json"));
    let (build, shade) = (
        |name: &str| build[name].as_f64().unwrap_or_else(|| panic!("{name}")),
        |name: &str| shade[name].as_f64().unwrap_or_else(|| panic!("{name}")),
    );
    assert!((59_000.0..61_000.0).contains(&build("points")));
    assert_eq!(build("points"), shade("points"));
    assert_eq!(build("nodes"), shade("nodes"));
    assert!(build("bytes_written") >= build("out_of_core_bytes"));
    let files = ["nodes.pages", "points.pages", "manifest.toml"];
    let size = |file| std::fs::metadata(house.path("again.pbgi").join(file)).unwrap().len() as f64;
    assert!(build("out_of_core_bytes") <= files.map(size).iter().sum());
    assert_eq!(shade("holes"), 0.0);
    assert_eq!(shade("shading_calls"), 64.0 * 64.0);
    assert!(shade("shading_seconds") > 0.0 && shade("shading_cpu_seconds") > 0.0);
    assert!(shade("cache_peak_bytes") <= shade("out_of_core_bytes"));
    assert!(shade("cache_peak_bytes") < shade("peak_memory_bytes"));
    assert!(shade("peak_memory_bytes") <= 256.0 * 1024.0 * 1024.0);
    for ratio in ["cache_hit_ratio", "cache_io_ratio"] {
        assert!((0.0..=1.0).contains(&shade(ratio)), "{ratio}");
    }
    assert!(shade("cache_hit_ratio") > 0.9);
    assert_eq!(shade("redundant_reads"), 0.0);
    assert_eq!(shade("reloads"), 0.0);
    assert_eq!(shade("cache_misses"), shade("pages_loaded"));
    assert!(shade("pages_loaded") <= page_count(&house.path("again.pbgi")) as f64);
    assert!(shade("bytes_read") <= shade("out_of_core_bytes"));
    assert!(shade("average_cut_size") > 10.0);
    assert!(shade("average_nodes_traversed") > 10.0);
    assert!(shade("average_traversal_bytes") <= shade("out_of_core_bytes"));
}
