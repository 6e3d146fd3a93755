//! Materials and textures.

use super::{SQUARE, SUN, assert_near, lit, try_load, write};
use crate::common::{assert_says, sample};
use pbgi_points::{Density, GBuffer, MeshScene};
use std::path::Path;

/// A material of this surface, and shaders beside it.
fn material(name: &str, surface: &str, more: &str) -> String {
    format!(
        "def Material \"{name}\" {{
            token outputs:surface.connect = </{name}/Surface.outputs:surface>
            def Shader \"Surface\" {{ uniform token info:id = \"UsdPreviewSurface\" {surface} token outputs:surface }}
            {more} }}"
    )
}

fn picture(folder: &Path, name: &str, width: u32, texels: &[[u8; 4]]) {
    let raw: Vec<u8> = texels.iter().flatten().copied().collect();
    let height = texels.len() as u32 / width;
    image::save_buffer(folder.join(name), &raw, width, height, image::ExtendedColorType::Rgba8).unwrap();
}

/// A texture of a file, laid by `st`.
fn texture(name: &str, file: &str, more: &str) -> String {
    format!(
        "def Shader \"{name}\" {{ uniform token info:id = \"UsdUVTexture\" asset inputs:file = @{file}@ {more}
            token inputs:wrapS = \"clamp\" token inputs:wrapT = \"clamp\" float3 outputs:rgb float outputs:r float outputs:a }}"
    )
}

#[test]
fn faces_have_the_materials_of_their_subsets() {
    let points = lit(&format!(
        "{} {}
         def Mesh \"M\" (prepend apiSchemas = [\"MaterialBindingAPI\"]) {{
            int[] faceVertexCounts = [4, 4]
            int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 4, 5]
            point3f[] points = [(0,0,0), (0,0,1), (1,0,1), (1,0,0), (2,0,1), (2,0,0)]
            rel material:binding = </Red>
            def GeomSubset \"Right\" (prepend apiSchemas = [\"MaterialBindingAPI\"]) {{
                uniform token elementType = \"face\" uniform token familyName = \"materialBind\"
                int[] indices = [1] rel material:binding = </Green> }} }}",
        material("Red", "color3f inputs:diffuseColor = (0.5, 0, 0)", ""),
        material(
            "Green",
            "color3f inputs:diffuseColor = (0, 0.25, 0) color3f inputs:emissiveColor = (0, 0, 2)",
            ""
        ),
    ));
    for point in points {
        let expected = if point.position[0] < 1.0 {
            [0.5, 0.0, 0.0]
        } else {
            [0.0, 0.25, 2.0]
        };
        assert_near(point.sides().front, expected, 5e-3);
        assert_eq!(point.sides().back[2], 0.0, "the back of a one-sided mesh does not glow");
    }
}

#[test]
fn the_nearest_binding_holds_unless_a_stronger_one_is_above() {
    let materials = ["Low", "High"].map(|name| {
        let level = if name == "Low" { 0.25 } else { 0.75 };
        material(name, &format!("color3f inputs:diffuseColor = ({level}, 0, 0)"), "")
    });
    for (strength, purpose, expected) in [
        ("", "", 0.75),
        ("(bindMaterialAs = \"strongerThanDescendants\")", "", 0.25),
        ("", ":preview", 0.75),
        ("", ":full", 0.25),
    ] {
        let points = lit(&format!(
            "{} def Xform \"A\" {{ rel material:binding = </Low> {strength}
                def Mesh \"M\" {{ {SQUARE} rel material:binding{purpose} = </High> }} }}",
            materials.join("\n"),
        ));
        assert_near(points[0].sides().front, [expected, 0.0, 0.0], 2e-3);
    }
}

#[test]
fn colours_of_the_mesh_stand_in_for_a_material() {
    let colored = |color: &str| lit(&format!("def Xform \"A\" {{ def Mesh \"M\" {{ {SQUARE} {color} }} }}"));
    assert_near(colored("")[0].sides().front, [0.18; 3], 1e-3);
    let one = colored("color3f[] primvars:displayColor = [(0.5, 0.25, 0)]");
    assert_near(one[0].sides().front, [0.5, 0.25, 0.0], 2e-3);
    let many = colored(
        "color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0)] (interpolation = \"vertex\")
         int[] primvars:displayColor:indices = [0, 0, 1, 1]",
    );
    assert_near(many[0].sides().front, [0.5, 0.5, 0.0], 2e-3);
    let inherited = lit(&format!(
        "def Xform \"A\" {{ color3f[] primvars:displayColor = [(0, 0, 0.5)] def Mesh \"M\" {{ {SQUARE} }} }}"
    ));
    assert_near(inherited[0].sides().front, [0.0, 0.0, 0.5], 2e-3);
}

/// What lies at the four quarters of the square, seen from above: left and right of the back, then of the front.
fn quarters(folder: &Path, text: &str) -> GBuffer {
    let scene = MeshScene::load(&write(folder, "scene.usda", &format!("{SUN}{text}"))).unwrap();
    let above = glam::Vec3::new(0.5, 100.0, 0.5);
    let camera = pbgi_points::Camera::look_at_upright(above, above - glam::Vec3::Y, glam::Vec3::NEG_Z, 0.01);
    GBuffer::render(&scene, &camera, 2, 2).unwrap()
}

/// The square with coordinates whose t grows to the back.
fn laid(material: &str) -> String {
    format!(
        "def Mesh \"M\" {{ {SQUARE} rel material:binding = </{material}>
            texCoord2f[] primvars:st = [(0, 1), (0, 0), (1, 0), (1, 1)] (interpolation = \"faceVarying\") }}"
    )
}

#[test]
fn textures_lie_as_their_coordinates_say() {
    let folder = tempfile::tempdir().unwrap();
    // Red above green, left of blue above grey.
    let texels = [
        [255, 0, 0, 255],
        [0, 0, 255, 255],
        [0, 255, 0, 255],
        [188, 188, 188, 255],
    ];
    picture(folder.path(), "t.png", 2, &texels);
    let see = |connect: &str, more: &str| {
        let shaders = format!(
            "{} {more}",
            texture("Tex", "t.png", &format!("float2 inputs:st.connect = <{connect}>"))
        );
        let surface = "color3f inputs:diffuseColor.connect = </Mat/Tex.outputs:rgb>";
        let seen = quarters(
            folder.path(),
            &format!("{} {}", material("Mat", surface, &shaders), laid("Mat")),
        );
        seen.albedo.unwrap()
    };
    let reader = "def Shader \"St\" { uniform token info:id = \"UsdPrimvarReader_float2\" string inputs:varname = \"st\" float2 outputs:result }";
    let plain = see("/Mat/St.outputs:result", reader);
    for (found, expected) in plain
        .iter()
        .zip([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.503; 3]])
    {
        assert_near(*found, expected, 5e-3);
    }
    // A quarter turn counter-clockwise of the coordinates turns the picture clockwise.
    let moved = "def Shader \"Turn\" { uniform token info:id = \"UsdTransform2d\" float inputs:rotation = 90 float2 inputs:translation = (1, 0)
        float2 inputs:in.connect = </Mat/St.outputs:result> float2 outputs:result }";
    let turned = see("/Mat/Turn.outputs:result", &format!("{reader} {moved}"));
    for (found, expected) in turned
        .iter()
        .zip([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.503; 3], [0.0, 0.0, 1.0]])
    {
        assert_near(*found, expected, 5e-3);
    }
}

#[test]
fn opacity_makes_holes() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "color.png", 1, &[[255, 0, 0, 0]]);
    picture(
        folder.path(),
        "mask.png",
        2,
        &[[255; 4], [0, 0, 0, 255], [255; 4], [255; 4]],
    );
    let shaders = format!(
        "{} {}",
        texture("Color", "color.png", ""),
        texture("Mask", "mask.png", "")
    );
    let see = |surface: &str| {
        let text = format!("{} {}", material("Mat", surface, &shaders), laid("Mat"));
        quarters(folder.path(), &text)
    };
    let masked = see(
        "color3f inputs:diffuseColor.connect = </Mat/Color.outputs:rgb> float inputs:opacity.connect = </Mat/Mask.outputs:r>",
    );
    // As fine as its own picture, whatever that of the colour.
    assert_eq!((masked.hole_count(), masked.is_hole(1)), (1, true));
    let masked = see("color3f inputs:diffuseColor = (0, 0.5, 0) float inputs:opacity.connect = </Mat/Mask.outputs:r>");
    assert_eq!((masked.hole_count(), masked.is_hole(1)), (1, true));
    assert_near(masked.albedo.unwrap()[0], [0.0, 0.5, 0.0], 2e-3);
    let own = see(
        "color3f inputs:diffuseColor.connect = </Mat/Color.outputs:rgb> float inputs:opacity.connect = </Mat/Color.outputs:a>",
    );
    assert_eq!(own.hole_count(), 4);
    let unconnected = see("color3f inputs:diffuseColor.connect = </Mat/Color.outputs:rgb>");
    assert_eq!(unconnected.hole_count(), 0, "an alpha that nothing uses");
    let threshold = |threshold: f32| {
        see(&format!(
            "float inputs:opacity = 0.4 float inputs:opacityThreshold = {threshold}"
        ))
    };
    assert_eq!([0.0, 0.3].map(|value| threshold(value).hole_count()), [4, 0]);
}

#[test]
fn scaled_and_raw_textures_have_their_values() {
    let folder = tempfile::tempdir().unwrap();
    picture(folder.path(), "grey.png", 1, &[[128, 128, 128, 255]]);
    let see = |more: &str| {
        let surface = "color3f inputs:diffuseColor.connect = </Mat/Tex.outputs:rgb> color3f inputs:emissiveColor.connect = </Mat/Tex.outputs:rgb>";
        let text = format!(
            "{} {}",
            material("Mat", surface, &texture("Tex", "grey.png", more)),
            laid("Mat")
        );
        let seen = quarters(folder.path(), &text);
        (seen.albedo.unwrap()[0][0], seen.emission.unwrap()[0][0])
    };
    let near = |found: (f32, f32), expected: f32| {
        assert!(
            (found.0 - expected).abs() < 5e-3 && (found.1 - expected).abs() < 5e-3,
            "{found:?}"
        )
    };
    near(see(""), 0.216);
    near(see("token inputs:sourceColorSpace = \"raw\""), 0.502);
    near(see("float4 inputs:scale = (2, 2, 2, 1)"), 0.432);
}

#[test]
fn what_cannot_be_read_of_a_material_is_told() {
    let mat = |surface: &str, more: &str| try_load(&format!("{} {}", material("Mat", surface, more), laid("Mat")));
    let connected = "color3f inputs:diffuseColor.connect = </Mat/Tex.outputs:rgb>";
    for (surface, shaders, words) in [
        (
            connected,
            texture("Tex", "no.png", ""),
            ["/Mat/Tex", "no.png", "copy it beside"],
        ),
        (
            connected,
            texture("Tex", "a.<UDIM>.png", ""),
            ["/Mat/Tex", "<UDIM>", "bake"],
        ),
        (
            connected,
            texture("Tex", "../../../etc/passwd", ""),
            ["outside of the scene's folder", "passwd", "beside"],
        ),
        (
            connected,
            "def Shader \"Tex\" { uniform token info:id = \"Noise\" float3 outputs:rgb }".to_owned(),
            ["/Mat/Tex", "Noise", "bake"],
        ),
        (
            "color3f inputs:diffuseColor = (-1, 0, 0)",
            String::new(),
            ["/Mat/Surface", "colour", "negative"],
        ),
    ] {
        assert_says(mat(surface, &shaders), &words);
    }
    let circle = "color3f inputs:a.connect = </Mat.inputs:b> color3f inputs:b.connect = </Mat.inputs:a>";
    assert_says(
        mat("color3f inputs:diffuseColor.connect = </Mat.inputs:a>", circle),
        &["connections", "cycle"],
    );
    // What we do not know is the colour of the mesh.
    let other = material("Mat", "", "").replace("UsdPreviewSurface", "ND_standard_surface_surfaceshader");
    let scene = try_load(&format!("{SUN} {other} {}", laid("Mat"))).unwrap();
    assert_near(sample(scene, Density::Points(50))[0].sides().front, [0.18; 3], 1e-3);
}
