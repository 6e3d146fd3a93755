//! Composition, other formats, and the same scene as glTF.

use super::{SQUARE, assert_near, write};
use crate::common::{GltfScene, assert_says, png_uri, sample};
use glam::Vec3;
use openusd::{usda, usdc, usdz};
use pbgi_points::{Density, InputOptions, LightKind, MeshScene, open_input, usd_files};
use serde_json::json;
use std::fs;
use std::path::Path;

const MOVED: &str = "double3 xformOp:translate = (5, 0, 0) uniform token[] xformOpOrder = [\"xformOp:translate\"]";

/// A folder of layers: a mesh asset, and a set that uses it.
fn layers(folder: &Path, root: &str) -> std::path::PathBuf {
    let asset = format!("(defaultPrim = \"Asset\")\n def Xform \"Asset\" {{ def Mesh \"M\" {{ {SQUARE} }} }}");
    write(folder, "assets/square.usda", &asset);
    write(
        folder,
        "sub.usda",
        &format!("over \"Set\" {{ over \"A\" {{ {MOVED} }} }}"),
    );
    write(folder, "scene.usda", root)
}

#[test]
fn sublayers_references_payloads_and_variants_compose() {
    let folder = tempfile::tempdir().unwrap();
    let root = "(subLayers = [@./sub.usda@])
        def Xform \"Set\" {
            def \"A\" (references = @./assets/square.usda@) { }
            def \"B\" (payload = @./assets/square.usda@</Asset/M>) { }
            def \"C\" (variants = { string size = \"big\" } prepend variantSets = \"size\") {
                variantSet \"size\" = {
                    \"big\" (references = @./assets/square.usda@) { float3 xformOp:scale = (1, 1, 10) uniform token[] xformOpOrder = [\"xformOp:scale\"] }
                    \"small\" { } } }
            def \"D\" (inherits = </Class>) { }
        }
        class \"Class\" (references = @./assets/square.usda@) { }";
    let path = layers(folder.path(), root);
    let scene = MeshScene::load(&path).unwrap();
    assert_eq!(scene.triangle_count(), 8);
    assert_near(scene.bounds().max, [6.0, 0.0, 10.0], 1e-6);
    let files = usd_files(&path).unwrap();
    let root = folder.path().canonicalize().unwrap();
    assert_eq!(
        files,
        ["assets/square.usda", "scene.usda", "sub.usda"].map(|name| root.join(name))
    );
}

#[test]
fn instances_are_there_as_often_as_they_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let instances: String = (0..3)
        .map(|index| {
            format!(
                "def \"I{index}\" (instanceable = true references = @./assets/square.usda@) {{
                    double3 xformOp:translate = ({}, 0, 0) uniform token[] xformOpOrder = [\"xformOp:translate\"] }}",
                2 * index
            )
        })
        .collect();
    let scene = MeshScene::load(&layers(folder.path(), &instances)).unwrap();
    assert_eq!(scene.triangle_count(), 6);
    assert_near(scene.bounds().max, [5.0, 0.0, 1.0], 1e-6);
    assert!((scene.area() - 3.0).abs() < 1e-9);
}

#[test]
fn what_does_not_compose_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let good = format!("def Mesh \"M\" {{ {SQUARE} }}");
    fs::write(folder.path().join("bad.usda"), "#usda 1.0\ndef {").unwrap();
    let inner = folder.path().join("inner");
    fs::create_dir(&inner).unwrap();
    for (arc, words) in [
        ("references = @./no.usda@", ["no.usda", "unresolved"]),
        ("references = @./bad.usda@", ["bad.usda", "does not compose"]),
        ("payload = @./assets/square.usda@</No>", ["/No", "does not compose"]),
        ("references = </A>", ["cycle", "does not compose"]),
        (
            "references = @../secret.usda@",
            ["secret.usda", "outside of the scene's folder"],
        ),
    ] {
        let path = layers(folder.path(), "");
        fs::write(folder.path().join("secret.usda"), fs::read(&path).unwrap()).unwrap();
        let path = if arc.contains("secret") {
            write(&inner, "scene.usda", "")
        } else {
            path
        };
        fs::write(&path, format!("#usda 1.0\n{good} def \"A\" ({arc}) {{ }}")).unwrap();
        assert_says(MeshScene::load(&path), &words);
    }
    let broken = write(
        folder.path(),
        "scene.usda",
        &format!("(subLayers = [@./no.usda@])\n{good}"),
    );
    assert_says(MeshScene::load(&broken), &["no.usda", "does not compose"]);
}

#[test]
fn binary_layers_and_packages_hold_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let text = format!("#usda 1.0\ndef Xform \"A\" {{ {MOVED} def Mesh \"M\" {{ {SQUARE} }} }}");
    let data = usda::parse(&text).unwrap();
    let mut layer = std::io::Cursor::new(Vec::new());
    usdc::CrateWriter::write(&data, &mut layer).unwrap();
    let layer = layer.into_inner();
    for name in ["a.usda", "a.usdc", "text.usd", "binary.usd", "a.usdz"] {
        let path = folder.path().join(name);
        match name {
            "a.usda" | "text.usd" => fs::write(&path, &text).unwrap(),
            "a.usdc" | "binary.usd" => fs::write(&path, &layer).unwrap(),
            _ => {
                let mut archive = usdz::ArchiveWriter::new(fs::File::create(&path).unwrap());
                archive.add_layer("root.usdc", &layer).unwrap();
                archive.finish().unwrap();
            }
        }
        let scene = MeshScene::load(&path).unwrap();
        assert_eq!(
            (scene.triangle_count(), scene.bounds().max),
            (2, [6.0, 0.0, 1.0]),
            "{name}"
        );
    }
}

/// Made by tests/usd/still_life.py with the reference implementation: z up, a textured table with a subset, instanced legs, scattered
/// balls, lights and a camera, all in a package.
#[test]
fn a_package_of_the_reference_implementation_is_read() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/usd/still_life.usdz");
    let scene = MeshScene::load(&path).unwrap();
    // Two quads of the table, four legs of six quads, three balls.
    assert_eq!(scene.triangle_count(), 4 + 4 * 12 + 3 * 2 * 48 * 23 + 2);
    assert_near(scene.bounds().min, [-1.0, 0.0, -1.0], 1e-4);
    let [sun, lamp] = scene.lights() else {
        panic!("{:?}", scene.lights())
    };
    assert_eq!((sun.kind, lamp.kind), (LightKind::Directional, LightKind::Point));
    assert_near(sun.direction.to_array(), [0.0, -1.0, 0.0], 1e-5);
    assert_near(lamp.position.to_array(), [0.0, 3.0, 0.0], 1e-5);
    let camera = scene.camera(0).unwrap();
    assert_near(camera.eye().to_array(), [0.0, 2.0, 6.0], 1e-5);
    assert_near(camera.direction(0, 0, 1, 1).to_array(), [0.0, 0.0, -1.0], 1e-5);
    let seen = pbgi_points::GBuffer::render(&scene, &camera, 32, 24).unwrap();
    assert!(seen.hole_count() < 32 * 24);
    let files = usd_files(&path).unwrap();
    assert_eq!(files, [path.canonicalize().unwrap()]);
}

#[test]
fn a_stage_goes_wherever_a_mesh_goes() {
    let folder = tempfile::tempdir().unwrap();
    let stage = write(
        folder.path(),
        "a.usda",
        &format!("def Mesh \"M\" {{ {SQUARE} }} def SphereLight \"L\" {{ float inputs:radius = 0 }}"),
    );
    let scene = folder.path().join("scene.toml");
    fs::write(
        &scene,
        "[[mesh]]\nfile = \"a.usda\"\ninstances = [{}, { translate = [3, 0, 0] }]\n",
    )
    .unwrap();
    let loaded = MeshScene::load(&scene).unwrap();
    assert_eq!((loaded.triangle_count(), loaded.lights().len()), (4, 2));
    let options = InputOptions {
        density: Density::Points(100),
        ..InputOptions::default()
    };
    let mut input = open_input(&[stage.clone(), scene], &options).unwrap();
    assert!(crate::common::collect(&mut input).len() > 80);
    let small = InputOptions {
        memory_bytes: 100,
        ..options
    };
    assert_says(open_input(&[stage], &small), &["memory", "--memory"]);
}

#[test]
fn the_same_scene_as_gltf_is_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let texels = [
        [255, 0, 0, 255],
        [0, 0, 255, 255],
        [0, 255, 0, 255],
        [188, 188, 188, 255],
    ];
    let mut gltf = GltfScene::new();
    let image = gltf.push("images", json!({ "uri": png_uri(2, 2, &texels) }));
    let texture = gltf.push("textures", json!({ "source": image }));
    let wood = gltf.push(
        "materials",
        json!({ "pbrMetallicRoughness": { "baseColorTexture": { "index": texture } } }),
    );
    let glow = gltf.push(
        "materials",
        json!({ "pbrMetallicRoughness": { "baseColorFactor": [0.2, 0.3, 0.4, 1.0] }, "emissiveFactor": [1.0, 0.5, 0.0], "doubleSided": true }),
    );
    let floor = gltf.rectangle(Vec3::ZERO, Vec3::Z * 4.0, Vec3::X * 4.0, Some(wood));
    let panel = gltf.rectangle(Vec3::ZERO, Vec3::X, Vec3::Z, Some(glow));
    gltf.node(json!({ "mesh": floor }));
    gltf.node(json!({ "mesh": panel, "translation": [1.0, 3.0, 1.0], "scale": [2.0, 1.0, 1.0] }));
    let half = std::f64::consts::FRAC_1_SQRT_2;
    gltf.light(
        json!({ "type": "directional", "color": [1.0, 0.5, 0.25], "intensity": 3.0 }),
        json!({ "rotation": [-half, 0.0, 0.0, half] }),
    );
    gltf.light(
        json!({ "type": "point", "intensity": 5.0 }),
        json!({ "translation": [2.0, 1.0, 2.0] }),
    );
    let camera = gltf.push(
        "cameras",
        json!({ "type": "perspective", "perspective": { "yfov": 2.0 * 0.5f64.atan(), "aspectRatio": 1.5, "znear": 0.1 } }),
    );
    gltf.node(json!({ "camera": camera, "translation": [2.0, 2.0, 9.0] }));
    let gltf = gltf.load().unwrap();

    let raw: Vec<u8> = texels.iter().flatten().copied().collect();
    image::save_buffer(
        folder.path().join("wood.png"),
        &raw,
        2,
        2,
        image::ExtendedColorType::Rgba8,
    )
    .unwrap();
    let surface = "uniform token info:id = \"UsdPreviewSurface\" token outputs:surface";
    let quad = "int[] faceVertexCounts = [4] int[] faceVertexIndices = [0, 1, 2, 3]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = \"vertex\")";
    let usd = write(
        folder.path(),
        "scene.usda",
        &format!(
            "def Mesh \"Floor\" {{ {quad} rel material:binding = </Wood> point3f[] points = [(0,0,0), (0,0,4), (4,0,4), (4,0,0)] }}
             def Mesh \"Panel\" {{ {quad} rel material:binding = </Glow> point3f[] points = [(0,0,0), (1,0,0), (1,0,1), (0,0,1)]
                uniform bool doubleSided = true
                double3 xformOp:translate = (1, 3, 1) float3 xformOp:scale = (2, 1, 1)
                uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:scale\"] }}
             def Material \"Wood\" {{ token outputs:surface.connect = </Wood/S.outputs:surface>
                def Shader \"S\" {{ {surface} color3f inputs:diffuseColor.connect = </Wood/T.outputs:rgb> }}
                def Shader \"T\" {{ uniform token info:id = \"UsdUVTexture\" asset inputs:file = @wood.png@
                    token inputs:wrapS = \"repeat\" token inputs:wrapT = \"repeat\" float3 outputs:rgb }} }}
             def Material \"Glow\" {{ token outputs:surface.connect = </Glow/S.outputs:surface>
                def Shader \"S\" {{ {surface} color3f inputs:diffuseColor = (0.2, 0.3, 0.4) color3f inputs:emissiveColor = (1, 0.5, 0) }} }}
             def DistantLight \"Sun\" {{ float inputs:angle = 0 float inputs:intensity = 3 color3f inputs:color = (1, 0.5, 0.25)
                float xformOp:rotateX = -90 uniform token[] xformOpOrder = [\"xformOp:rotateX\"] }}
             def SphereLight \"Lamp\" {{ float inputs:radius = 0 float inputs:intensity = 5
                double3 xformOp:translate = (2, 1, 2) uniform token[] xformOpOrder = [\"xformOp:translate\"] }}
             def Camera \"View\" {{ float focalLength = 24 float verticalAperture = 24 float horizontalAperture = 36
                double3 xformOp:translate = (2, 2, 9) uniform token[] xformOpOrder = [\"xformOp:translate\"] }}"
        ),
    );
    let usd = MeshScene::load(&usd).unwrap();
    assert_eq!(
        (usd.triangle_count(), usd.bounds(), usd.area()),
        (gltf.triangle_count(), gltf.bounds(), gltf.area())
    );
    for (ours, theirs) in usd.lights().iter().zip(gltf.lights()) {
        assert_eq!(
            (ours.kind, ours.intensity, ours.range),
            (theirs.kind, theirs.intensity, theirs.range)
        );
        assert!(ours.kind == LightKind::Point || ours.direction.distance(theirs.direction) < 1e-6);
        assert!(ours.kind == LightKind::Directional || ours.position == theirs.position);
    }
    let ([ours], [theirs]) = (usd.cameras(), gltf.cameras()) else {
        panic!()
    };
    assert!((ours.fov_y - theirs.fov_y).abs() < 1e-6 && ours.world_from_camera == theirs.world_from_camera);
    assert_eq!(ours.aspect_ratio, theirs.aspect_ratio);
    let [ours, theirs] = [usd, gltf].map(|scene| sample(scene, Density::Points(2_000)));
    assert_eq!(ours.len(), theirs.len());
    for (ours, theirs) in ours.iter().zip(&theirs) {
        assert_eq!((ours.position, ours.normal()), (theirs.position, theirs.normal()));
        let sides = |point: &pbgi_core::PointRecord| [point.sides().front, point.sides().back];
        for (ours, theirs) in sides(ours).into_iter().zip(sides(theirs)) {
            assert_near(ours, theirs, 1e-2);
        }
    }
}
