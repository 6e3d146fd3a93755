//! Pictures against ground truth: Monte Carlo ray tracing of the same mesh, made without this code.

use pbgi_tests::{House, Picture, assert_same_values, relative_rms, rms, shared};

const COLOURS: [&str; 3] = ["indirect.R", "indirect.G", "indirect.B"];

/// Pixels whose position lies on two walls of the box from (-1, 0, -1) to (1, 2, 1) at once.
fn on_edges(gbuffer: &Picture) -> Vec<bool> {
    const TOUCH: f32 = 1e-4;
    let [x, y, z] = ["P.X", "P.Y", "P.Z"].map(|name| gbuffer.channel(name));
    let walls = |i: usize| [x[i] + 1.0, x[i] - 1.0, y[i], y[i] - 2.0, z[i] + 1.0].map(f32::abs);
    (0..x.len())
        .map(|i| walls(i).iter().filter(|distance| **distance < TOUCH).count() > 1)
        .collect()
}

#[test]
fn cornell_box_is_close_to_the_ray_traced_reference() {
    let names = ["cornell.glb", "cornell.gbuffer.exr", "cornell.reference.exr"];
    let [Some(mesh), Some(gbuffer), Some(reference)] = names.map(|name| shared(&format!("reference/{name}"))) else {
        return;
    };
    let house = House::new();
    let daemon = "--memory 512M --workers 2";
    house.line(&format!("sample {} -o points.ply", mesh.display())).ok();
    house.line(&format!("build points.ply -o cornell.pbgi {daemon}")).ok();
    let shade = |name: &str, options: &str| {
        let gbuffer = gbuffer.display();
        house
            .line(&format!(
                "shade cornell.pbgi --gbuffer {gbuffer} -o {name} {options} {daemon}"
            ))
            .ok();
        Picture::read(&house.path(name))
    };
    let (whole, near) = (shade("whole.exr", ""), shade("near.exr", "--max-dist 0.5"));
    let reference = Picture::read(&reference);
    let gbuffer = Picture::read(&gbuffer);
    let all = gbuffer.channel("A").to_vec();
    // Where the camera's ray meets two walls in their common edge, the reference's own rays start inside a wall.
    let edges = on_edges(&gbuffer);
    let inner: Vec<f32> = all
        .iter()
        .zip(&edges)
        .map(|(a, edge)| if *edge { 0.0 } else { *a })
        .collect();
    let figures = |mask: &[f32]| {
        let occlusion = rms(whole.channel("occlusion.Z"), reference.channel("occlusion.Z"), mask);
        let near = rms(near.channel("occlusion.Z"), reference.channel("occlusion_d.Z"), mask);
        let pairs = COLOURS.map(|name| (whole.channel(name), reference.channel(name)));
        (occlusion, near, relative_rms(&pairs, mask))
    };
    let (occlusion, occlusion_near, indirect) = figures(&inner);
    eprintln!("occlusion {occlusion:.4}, within 0.5 m {occlusion_near:.4}, indirect {indirect:.4}");
    let count = edges.iter().filter(|edge| **edge).count();
    eprintln!("with the {count} pixels on the box's edges: {:.4?}", figures(&all));
    assert!(count < all.len() / 100, "{count} pixels lie on edges");
    assert!(occlusion <= 0.02, "occlusion is off by {occlusion}");
    assert!(
        occlusion_near <= 0.02,
        "occlusion within 0.5 m is off by {occlusion_near}"
    );
    assert!(indirect <= 0.06, "indirect light is off by {indirect}");
    // The maximum distance acts on occlusion and bent normal only.
    for name in COLOURS {
        assert_same_values(name, whole.channel(name), near.channel(name));
    }
}
