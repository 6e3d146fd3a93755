//! Meshes and shapes, and where they are.

use super::{SQUARE, SUN, assert_near, lit, load, try_load};
use crate::common::{assert_says, sample};
use pbgi_points::{Density, MeshScene};

fn bounds(scene: &MeshScene) -> ([f32; 3], [f32; 3]) {
    (scene.bounds().min, scene.bounds().max)
}

#[test]
fn polygons_may_be_concave_and_have_holes() {
    // A letter of seven squares, and a triangle that is a hole.
    let scene = load(
        "def Mesh \"E\" {
            int[] faceVertexCounts = [8, 3]
            int[] faceVertexIndices = [0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2]
            int[] holeIndices = [1]
            point3f[] points = [(0,0,0), (3,0,0), (3,1,0), (1,1,0), (1,2,0), (3,2,0), (3,3,0), (0,3,0)]
        }",
    );
    assert!((scene.area() - 7.0).abs() < 1e-9, "{}", scene.area());
    assert_eq!(scene.triangle_count(), 6);
}

#[test]
fn a_left_handed_mesh_faces_the_other_way() {
    for (orientation, up) in [("rightHanded", 1.0), ("leftHanded", -1.0)] {
        let points = lit(&format!(
            "def Mesh \"M\" {{ {SQUARE} uniform token orientation = \"{orientation}\" }}"
        ));
        assert!(
            points.iter().all(|point| (point.normal()[1] - up).abs() < 0.01),
            "{orientation}"
        );
    }
}

#[test]
fn normals_may_belong_to_corners() {
    let lean = "(0.28, 0.96, 0)";
    let text = format!(
        "def Mesh \"M\" {{ {SQUARE} normal3f[] primvars:normals = [{lean}, {lean}, {lean}, {lean}] (interpolation = \"faceVarying\") }}
         {SUN}"
    );
    let scene = load(&text);
    let camera = pbgi_points::Camera::look_at(glam::Vec3::new(0.5, 3.0, 0.5), glam::Vec3::new(0.5, 0.0, 0.5), 0.2);
    let buffer = pbgi_points::GBuffer::render(&scene, &camera, 3, 3).unwrap();
    assert_near(buffer.normal[4], [0.28, 0.96, 0.0], 1e-3);
}

#[test]
fn transforms_stack_and_z_is_turned_up() {
    let place = "
        double3 xformOp:translate = (10, 0, 0)
        float3 xformOp:rotateXYZ = (0, 90, 0)
        float3 xformOp:scale = (2, 1, 1)
        uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:rotateXYZ\", \"xformOp:scale\"]
    ";
    // x is doubled, turned to -z, moved along x; the child's own comes first.
    let text = format!(
        "def Xform \"A\" {{ {place}
            def Mesh \"M\" {{ {SQUARE}
                double3 xformOp:translate = (0, 5, 0)
                uniform token[] xformOpOrder = [\"xformOp:translate\"] }}
            def Mesh \"Apart\" {{ {SQUARE}
                double3 xformOp:translate = (0, -5, 0)
                uniform token[] xformOpOrder = [\"!resetXformStack!\", \"xformOp:translate\"] }} }}"
    );
    let (min, max) = bounds(&load(&text));
    assert_near(min, [0.0, -5.0, -2.0], 1e-5);
    assert_near(max, [11.0, 5.0, 1.0], 1e-5);
    let (min, max) = bounds(&load(&format!("(upAxis = \"Z\"\n metersPerUnit = 0.01)\n{text}")));
    assert_near(min, [0.0, -2.0, -5.0], 1e-5);
    assert_near(max, [11.0, 1.0, 5.0], 1e-5);
}

#[test]
fn what_is_not_for_pictures_is_not_drawn() {
    let scene = load(&format!(
        "def Mesh \"Drawn\" {{ {SQUARE} uniform token purpose = \"render\" }}
         def Mesh \"Guide\" {{ {SQUARE} uniform token purpose = \"guide\" }}
         def Mesh \"Gone\" (active = false) {{ {SQUARE} }}
         class Mesh \"Class\" {{ {SQUARE} }}
         over \"Over\" {{ def Mesh \"M\" {{ {SQUARE} }} }}
         def Xform \"Proxy\" {{ uniform token purpose = \"proxy\" def Mesh \"M\" {{ {SQUARE} }} }}
         def Xform \"Hidden\" {{ token visibility = \"invisible\"
            def Mesh \"M\" {{ {SQUARE} token visibility = \"inherited\" }}
            def Camera \"View\" {{ }} }}"
    ));
    assert_eq!(scene.triangle_count(), 2);
    assert_eq!(
        scene.cameras()[0].name.as_deref(),
        Some("View"),
        "a camera sees nevertheless"
    );
}

#[test]
fn shapes_are_surfaces() {
    for (shape, area) in [
        ("Sphere \"S\" { double radius = 2 }", 16.0 * std::f64::consts::PI),
        ("Cube \"S\" { }", 24.0),
        (
            "Cylinder \"S\" { token axis = \"Y\" double height = 3 }",
            8.0 * std::f64::consts::PI,
        ),
        (
            "Cone \"S\" { double radius = 3 double height = 4 }",
            24.0 * std::f64::consts::PI,
        ),
        ("Plane \"S\" { double width = 4 }", 8.0),
    ] {
        let scene = load(&format!("def {shape}"));
        assert!((scene.area() / area - 1.0).abs() < 0.01, "{shape}: {}", scene.area());
    }
    let (min, max) = bounds(&load("def Cone \"S\" { token axis = \"X\" double height = 4 }"));
    assert_near(min, [-2.0, -1.0, -1.0], 1e-5);
    assert_near(max, [2.0, 1.0, 1.0], 1e-5);
}

#[test]
fn values_are_those_of_the_first_frame() {
    let moves = "
        double3 xformOp:translate.timeSamples = { -10: (7, 0, 0), 1: (1, 0, 0), 24: (2, 0, 0) }
        uniform token[] xformOpOrder = [\"xformOp:translate\"]
    ";
    let text = format!("def Mesh \"M\" {{ {SQUARE} {moves} }}");
    assert_near(
        bounds(&load(&format!("(startTimeCode = 1)\n{text}"))).0,
        [1.0, 0.0, 0.0],
        1e-6,
    );
    assert_near(bounds(&load(&text)).0, [7.0, 0.0, 0.0], 1e-6);
}

#[test]
fn what_is_wrong_with_a_mesh_is_told_with_its_path() {
    let mesh = |body: &str| try_load(&format!("def Xform \"A\" {{ def Mesh \"M\" {{ {body} }} }}"));
    for (from, to, word) in [
        ("[0, 1, 2, 3]", "[0, 1, 2, 9]", "9, which is beyond its 4 points"),
        ("[0, 1, 2, 3]", "[0, 1, 2, -1]", "-1, which is beyond"),
        ("[4]", "[5]", "5 corners in all"),
        ("[4]", "[-4]", "face 0 has -4 corners"),
        ("(1, 0, 1)", "(nan, 0, 1)", "point 2 is not finite"),
    ] {
        assert_says(mesh(&SQUARE.replace(from, to)), &["/A/M", word, "scene.usda"]);
    }
    for (more, word) in [
        ("int[] holeIndices = [1]", "holeIndices"),
        ("normal3f[] normals = [(0, 1, 0)]", "normals has 1 values, must have 4"),
        (
            "float3 xformOp:scale = (inf, 1, 1) uniform token[] xformOpOrder = [\"xformOp:scale\"]",
            "not finite",
        ),
        ("color3f[] primvars:displayColor = [(-1, 0, 0)]", "displayColor"),
    ] {
        assert_says(mesh(&format!("{SQUARE} {more}")), &["/A/M", word]);
    }
    assert_says(try_load("def Xform \"A\" { }"), &["no triangles"]);
    assert_says(try_load("def Xform \"A {"), &["scene.usda", "not a usable USD file"]);
}

#[test]
fn a_scattered_mesh_is_kept_once() {
    let scattered = |count: usize| {
        let positions: Vec<String> = (0..count).map(|index| format!("({}, 0, 0)", 3 * index)).collect();
        load(&format!(
            "def PointInstancer \"I\" {{
                rel prototypes = [</I/Protos/Ball>, </I/Protos/Lamp>]
                int[] protoIndices = [{}]
                point3f[] positions = [{}]
                int64[] invisibleIds = [1]
                over \"Protos\" {{
                    def Sphere \"Ball\" {{
                        double3 xformOp:translate = (0, 1, 0)
                        uniform token[] xformOpOrder = [\"xformOp:translate\"] }}
                    def SphereLight \"Lamp\" {{ bool treatAsPoint = true }} }} }}",
            vec!["0"; count - 1].join(", ") + ", 1",
            positions.join(", "),
        ))
    };
    let (few, many) = (scattered(100), scattered(200));
    // One hides, one is a lamp; the poles of a ball have triangles without area, which are left out.
    assert_eq!(few.triangle_count() / 98, 2 * 48 * 23);
    assert_eq!(many.triangle_count() / 198, 2 * 48 * 23);
    assert_eq!((few.lights().len(), few.lights()[0].position.x), (1, 297.0));
    assert_near(many.bounds().max, [595.0, 2.0, 1.0], 1e-4);
    assert!(
        many.memory_bytes() - few.memory_bytes() <= 100 * 500,
        "{}",
        many.memory_bytes()
    );
    let points = sample(few, Density::Points(1000));
    assert!(
        points.iter().all(|point| !(1.5..4.5).contains(&point.position[0])),
        "the second is invisible"
    );
}
