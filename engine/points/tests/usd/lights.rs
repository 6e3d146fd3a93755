//! Lights, skies and cameras.

use super::{SQUARE, assert_near, load, try_load, write};
use crate::common::{assert_says, sample};
use pbgi_points::{Density, LayeredImage, LightKind, MeshScene, Precision};
use std::f32::consts::PI;

fn with(lights: &str) -> MeshScene {
    load(&format!("def Mesh \"M\" {{ {SQUARE} }}\n{lights}"))
}

#[test]
fn distant_lights_travel_along_minus_z() {
    let place = "float xformOp:rotateX = -90 uniform token[] xformOpOrder = [\"xformOp:rotateX\"]";
    let scene = with(&format!(
        "def DistantLight \"A\" {{ float inputs:angle = 0 float inputs:intensity = 2 float inputs:exposure = 3
            color3f inputs:color = (1, 0.5, 0) {place} }}
         def DistantLight \"B\" {{ float inputs:angle = 60 float inputs:intensity = 4 }}
         def DistantLight \"C\" {{ float inputs:angle = 60 float inputs:intensity = 4 bool inputs:normalize = true }}
         def DistantLight \"D\" {{ }}"
    ));
    let [a, b, c, d] = scene.lights() else {
        panic!("{:?}", scene.lights())
    };
    assert_eq!(a.kind, LightKind::Directional);
    assert_near(a.intensity, [16.0, 8.0, 0.0], 1e-5);
    assert_near(a.direction.to_array(), [0.0, -1.0, 0.0], 1e-6);
    assert_near(b.intensity, [PI; 3], 1e-5);
    assert_near(c.intensity, [4.0; 3], 1e-5);
    // The schema's sun: 50,000 nits over half a degree.
    assert_near(d.intensity, [3.36; 3], 0.01);
}

#[test]
fn points_and_spots_are_spheres_without_extent() {
    let scene = with(
        "def SphereLight \"A\" { float inputs:radius = 0 float inputs:intensity = 2
            double3 xformOp:translate = (1, 2, 3) uniform token[] xformOpOrder = [\"xformOp:translate\"] }
         def SphereLight \"B\" { bool treatAsPoint = true float inputs:radius = 2 bool inputs:normalize = true float inputs:intensity = 8 }
         def SphereLight \"C\" (prepend apiSchemas = [\"ShapingAPI\"]) { float inputs:radius = 1 float inputs:shaping:cone:angle = 60
            float inputs:shaping:cone:softness = 0.5 }
         def SphereLight \"D\" { bool treatAsPoint = true bool inputs:enableColorTemperature = true float inputs:colorTemperature = 3000
            float inputs:radius = 0 }",
    );
    let [a, b, c, d] = scene.lights() else {
        panic!("{:?}", scene.lights())
    };
    assert_eq!(
        (a.kind, a.intensity, a.position.to_array()),
        (LightKind::Point, [2.0; 3], [1.0, 2.0, 3.0])
    );
    assert_near(b.intensity, [2.0; 3], 1e-6);
    assert_near(c.intensity, [PI; 3], 1e-5);
    let LightKind::Spot { cos_inner, cos_outer } = c.kind else {
        panic!("{c:?}")
    };
    assert!((cos_inner - 0.75f32.sqrt()).abs() < 1e-6 && (cos_outer - 0.5).abs() < 1e-6);
    // UsdLuxBlackbodyTemperatureAsRgb(3000) over that of 6500, of unit luminance.
    assert_near(d.intensity, [1.708, 0.864, 0.265], 0.05);
}

#[test]
fn lights_with_extent_are_surfaces_that_glow_on_one_side() {
    let scene = load(
        "def RectLight \"A\" { float inputs:width = 2 float inputs:height = 3 float inputs:intensity = 6 }
         def RectLight \"B\" { float inputs:width = 2 float inputs:height = 3 float inputs:intensity = 12 bool inputs:normalize = true
            double3 xformOp:translate = (5, 0, 0) float3 xformOp:scale = (2, 1, 1)
            uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:scale\"] }",
    );
    assert!((scene.area() - 18.0).abs() < 1e-6);
    let points = sample(scene, Density::Points(100));
    for point in points {
        let expected = if point.position[0] < 2.0 { 6.0 } else { 1.0 };
        assert!(point.normal()[2] < -0.99);
        assert_near(point.sides().front, [expected; 3], 0.02);
        assert_eq!(point.sides().back, [0.0; 3]);
    }
    let globe = load(
        "def SphereLight \"A\" { float inputs:radius = 2 float inputs:intensity = 3 bool inputs:normalize = true }",
    );
    assert!(
        (globe.area() / f64::from(16.0 * PI) - 1.0).abs() < 1e-4,
        "{}",
        globe.area()
    );
    let points = sample(globe, Density::Points(100));
    assert!(
        points
            .iter()
            .all(|point| (point.sides().front[0] * 16.0 * PI - 3.0).abs() < 0.01)
    );
}

#[test]
fn a_sky_is_turned_and_multiplied_as_the_stage_says() {
    let folder = tempfile::tempdir().unwrap();
    // Bright where its middle is, and there only.
    let pixels: Vec<[f32; 3]> = (0..8 * 4).map(|index| [f32::from(index % 8 == 4), 0.0, 0.0]).collect();
    let mut picture = LayeredImage::new(8, 4);
    picture.add_rgb("", Precision::Float, &pixels);
    picture.write_exr(&folder.path().join("sky.exr")).unwrap();
    let sky = |head: &str, kind: &str, more: &str| {
        let text = format!(
            "{head} def Mesh \"M\" {{ {SQUARE} }} def {kind} \"Sky\" {{ asset inputs:texture:file = @sky.exr@ {more} }}"
        );
        let scene = MeshScene::load(&write(folder.path(), "scene.usda", &text)).unwrap();
        let baked = scene.environment().unwrap().bake().unwrap().triple("").unwrap();
        // The bright column of the row above the horizon, and how bright.
        let row: Vec<f32> = baked[8..16].iter().map(|pixel| pixel[0]).collect();
        let most = row.iter().copied().fold(0.0, f32::max);
        (row.iter().position(|value| *value == most).unwrap(), most)
    };
    // Ours look along -x, -z, +x, +z at columns 0, 2, 4 and 6 of 8. The middle of a dome is +z.
    let quarter = "float xformOp:rotateY = 90 uniform token[] xformOpOrder = [\"xformOp:rotateY\"]";
    let (plain, turned) = (sky("", "DomeLight", ""), sky("", "DomeLight", quarter));
    assert_eq!((plain.0, turned.0), (6, 4), "about y, +z goes to +x");
    assert!((plain.1 - 1.0).abs() < 1e-3);
    let bright = sky(
        "",
        "DomeLight_1",
        "float inputs:intensity = 3 float inputs:exposure = 1",
    );
    assert!(bright.0 == 6 && (bright.1 - 6.0).abs() < 1e-2);
    // Where z is up, the middle is -y, which is our +z.
    assert_eq!(sky("(upAxis = \"Z\")", "DomeLight_1", "").0, 6);
    let even = with("def DomeLight \"Sky\" { color3f inputs:color = (1, 0.5, 0) }");
    let baked = even.environment().unwrap().bake().unwrap().triple("").unwrap();
    assert!(baked.iter().all(|pixel| *pixel == [1.0, 0.5, 0.0]));
    assert_says(
        try_load(&format!(
            "def Mesh \"M\" {{ {SQUARE} }} def DomeLight \"Sky\" {{ asset inputs:texture:file = @no.exr@ }}"
        )),
        &["/Sky", "no.exr", "copy it beside"],
    );
}

#[test]
fn cameras_are_those_of_the_lens() {
    let scene = with(
        "def Camera \"Front\" { float focalLength = 20 float horizontalAperture = 40 float verticalAperture = 40
            double3 xformOp:translate = (0, 1, 5) float3 xformOp:scale = (2, 2, 2)
            uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:scale\"] }
         def Camera \"Plan\" { token projection = \"orthographic\" }
         def Camera \"Wide\" { }",
    );
    let [front, wide] = scene.cameras() else {
        panic!("{:?}", scene.cameras())
    };
    assert_eq!((front.name.as_deref(), front.aspect_ratio), (Some("Front"), Some(1.0)));
    assert!((front.fov_y - PI / 2.0).abs() < 1e-6);
    assert_eq!(front.eye().to_array(), [0.0, 1.0, 5.0]);
    assert_near(front.direction(1, 1, 3, 3).to_array(), [0.0, 0.0, -1.0], 1e-6);
    assert!((wide.aspect_ratio.unwrap() - 20.955 / 15.2908).abs() < 1e-5);
    assert_says(
        try_load(&format!(
            "def Mesh \"M\" {{ {SQUARE} }} def Camera \"C\" {{ float focalLength = 0 }}"
        )),
        &["/C", "focalLength is 0"],
    );
}
