//! Pictures against ground truth: Monte Carlo ray tracing of the same mesh, made without this code.

use pbgi_tests::{House, Picture, assert_same_values, relative_rms, rms, shared};

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
    let mask = Picture::read(&gbuffer).channel("A").to_vec();
    let occlusion = rms(whole.channel("occlusion.Z"), reference.channel("occlusion.Z"), &mask);
    let occlusion_near = rms(near.channel("occlusion.Z"), reference.channel("occlusion_d.Z"), &mask);
    let colours = ["indirect.R", "indirect.G", "indirect.B"];
    let pairs = colours.map(|name| (whole.channel(name), reference.channel(name)));
    let indirect = relative_rms(&pairs, &mask);
    eprintln!("occlusion {occlusion:.4}, within 0.5 m {occlusion_near:.4}, indirect {indirect:.4}");
    assert!(occlusion <= 0.02, "occlusion is off by {occlusion}");
    assert!(
        occlusion_near <= 0.02,
        "occlusion within 0.5 m is off by {occlusion_near}"
    );
    assert!(indirect <= 0.06, "indirect light is off by {indirect}");
    // The maximum distance acts on occlusion and bent normal only.
    for name in colours {
        assert_same_values(name, whole.channel(name), near.channel(name));
    }
}
