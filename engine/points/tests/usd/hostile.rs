//! Damaged and forged stages: an error, whatever they say.

use super::{SQUARE, try_load, write};
use crate::common::{assert_says, mutate};
use openusd::{usda, usdc};
use pbgi_points::MeshScene;
use std::fs;
use std::path::Path;

const STAGE: &str = "#usda 1.0
(upAxis = \"Z\"
 customLayerData = { dictionary a = { string b = \"c\" } })
def Xform \"A\" (customData = { int one = 1 }) {
    double3 xformOp:translate.timeSamples = { 1: (1, 2, 3), 2: (4, 5, 6) }
    uniform token[] xformOpOrder = [\"xformOp:translate\"]
    def Mesh \"M\" (prepend apiSchemas = [\"MaterialBindingAPI\"]) {
        int[] faceVertexCounts = [4, 4, 3, 3, 3, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 1, 0, 0, 1, 2, 1, 2, 3, 2, 3, 0, 3, 0, 1]
        point3f[] points = [(0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0)]
        float2[] primvars:st = [(0, 0), (0, 1), (1, 1), (1, 0)] (interpolation = \"vertex\")
        rel material:binding = </Mat>
    }
    def \"B\" (references = </A/M>) { }
}
def Material \"Mat\" {
    token outputs:surface.connect = </Mat/S.outputs:surface>
    def Shader \"S\" { uniform token info:id = \"UsdPreviewSurface\" color3f inputs:diffuseColor = (0.1, 0.2, 0.3) token outputs:surface }
}
def SphereLight \"L\" { float inputs:radius = 0.1 }
def Camera \"C\" { }
";

#[test]
fn damaged_stages_are_errors_or_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let binary = {
        let mut layer = std::io::Cursor::new(Vec::new());
        usdc::CrateWriter::write(&usda::parse(STAGE).unwrap(), &mut layer).unwrap();
        layer.into_inner()
    };
    for (name, bytes, count) in [("a.usda", STAGE.as_bytes(), 300), ("a.usdc", &binary, 600)] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        assert!(MeshScene::load(&path).unwrap().triangle_count() > 0, "{name}");
        let (mut refused, mut taken) = (0, 0);
        let mut read = |broken: &[u8]| {
            fs::write(&path, broken).unwrap();
            match MeshScene::load(&path) {
                Ok(_) => taken += 1,
                Err(error) => {
                    refused += 1;
                    assert!(error.to_string().contains(name), "{error}");
                }
            }
        };
        mutate(bytes, 8..bytes.len(), count, &mut read);
        (0..bytes.len())
            .step_by(bytes.len() / 100)
            .for_each(|length| read(&bytes[..length]));
        println!("{name}: {refused} refused, {taken} taken");
        assert!(refused > count / 4, "{name}: {refused} refused, {taken} taken");
    }
}

#[test]
fn what_would_never_end_is_refused() {
    let deep = |open: &str, close: &str| format!("{}{}", open.repeat(5_000), close.repeat(5_000));
    assert_says(
        try_load(&deep("def Xform \"A\" {\n", "}\n")),
        &["nested deeper", "line 258"],
    );
    let data = format!("def \"A\" (customData = {{ {} }}) {{ }}", deep("dictionary a = {", "}"));
    assert_says(try_load(&data), &["nested deeper"]);
    let own =
        "def PointInstancer \"I\" { rel prototypes = </I> int[] protoIndices = [0] point3f[] positions = [(0, 0, 0)] }";
    assert_says(try_load(own), &["/I", "holds itself"]);
    // Each level scatters the one below it ten times.
    let levels: String = (0..8)
        .map(|level| {
            let below = if level == 0 { "/Square".to_owned() } else { format!("/I{}", level - 1) };
            let places = ["(0, 0, 0)"; 10].join(", ");
            format!("def PointInstancer \"I{level}\" {{ rel prototypes = <{below}> int[] protoIndices = [0,0,0,0,0,0,0,0,0,0] point3f[] positions = [{places}] }}\n")
        })
        .collect();
    assert_says(
        try_load(&format!("def Mesh \"Square\" {{ {SQUARE} }}\n{levels}")),
        &["/I6", "placed meshes"],
    );
}

#[test]
fn a_folder_or_nothing_is_no_stage() {
    let folder = tempfile::tempdir().unwrap();
    assert_says(
        MeshScene::load(&folder.path().join("no.usda")),
        &["no.usda", "cannot open"],
    );
    let inner = folder.path().join("a.usdc");
    fs::create_dir(&inner).unwrap();
    assert_says(MeshScene::load(&inner), &["a.usdc"]);
    for name in ["a.usdz", "b.usdc", "c.usda"] {
        let path = folder.path().join("x").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "").unwrap();
        assert_says(MeshScene::load(&path), &[name]);
    }
    assert!(Path::new(&write(folder.path(), "d.usda", "")).is_absolute());
}
