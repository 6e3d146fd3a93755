//! Scenes come back as they were written, and damaged or foreign ones do not open.

use crate::support::{names, node, os_volume, point, read, settings, write};
use pbgi_core::{PageKind, PageNo};
use pbgi_store::{IoMode, Overwrite, Scene, SceneWriter, StoreError};
use std::fs;
use std::path::{Path, PathBuf};

const FILES: [&str; 3] = ["manifest.toml", "nodes.pages", "points.pages"];

fn scene_in(dir: &Path, points: u32, build_id: u128) -> PathBuf {
    let path = dir.join("city.pbgi");
    write(&os_volume(), &path, Overwrite::Refuse, points, build_id).unwrap();
    path
}

#[test]
fn a_scene_comes_back_as_it_was_written() {
    let dir = tempfile::tempdir().unwrap();
    for points in [1, 31, 32, 33, 100] {
        let path = dir.path().join(format!("{points}.pbgi"));
        let info = write(&os_volume(), &path, Overwrite::Refuse, points, 7).unwrap();
        let scene = Scene::open(&path).unwrap();
        assert_eq!(scene.info(), &info);
        scene.verify().unwrap();
        let (nodes, stored) = read(&scene);
        assert!((0..points).all(|i| stored[i as usize] == point(i)));
        let real: Vec<_> = nodes.iter().filter(|node| node.centroid != [0.0; 3]).collect();
        assert!((0..points).all(|i| *real[i as usize] == node(i)));
    }
}

#[test]
fn a_scene_without_points_is_valid() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 0, 1);
    let scene = Scene::open(&path).unwrap();
    assert_eq!((scene.info().point_count, scene.info().root), (0, None));
    scene.verify().unwrap();
    let error = scene.read_page(PageKind::Node, PageNo(0), &mut [0; 1792]).unwrap_err();
    assert!(
        matches!(error, StoreError::PageRange { page: 0, count: 0, .. }),
        "{error}"
    );
}

#[test]
fn pages_that_do_not_exist_or_fit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let scene = Scene::open(&scene_in(dir.path(), 100, 1)).unwrap();
    let mut page = vec![0; scene.info().page_bytes(PageKind::Point)];
    scene.read_page(PageKind::Point, PageNo(3), &mut page).unwrap();
    for number in [4, u32::MAX] {
        let error = scene.read_page(PageKind::Point, PageNo(number), &mut page).unwrap_err();
        assert!(matches!(error, StoreError::PageRange { count: 4, .. }), "{error}");
    }
    page.pop();
    let error = scene.read_page(PageKind::Point, PageNo(0), &mut page).unwrap_err();
    assert!(matches!(error, StoreError::Invalid(_)), "{error}");
}

#[test]
fn every_truncation_or_extension_is_refused_naming_both_lengths() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 100, 1);
    let mut refused = 0;
    for name in FILES {
        let file = path.join(name);
        let whole = fs::read(&file).unwrap();
        let len = whole.len();
        let boundaries = [0, 4096, 4096 + 1024, len - 16, len];
        let around = boundaries.iter().flat_map(|&b| [b.wrapping_sub(1), b, b + 1]);
        let spread = (0..70).map(|i| i * len / 70);
        for cut in around.chain(spread).filter(|&cut| cut != len && cut <= len + 1) {
            let mut bytes = whole.clone();
            bytes.resize(cut, 0);
            fs::write(&file, &bytes).unwrap();
            let error = Scene::open(&path)
                .err()
                .unwrap_or_else(|| panic!("{name} cut to {cut} bytes opens"));
            assert!(
                matches!(error, StoreError::Corrupt { .. }),
                "{name} cut to {cut}: {error}"
            );
            let text = error.to_string();
            if name.ends_with("pages") && cut >= 4096 {
                assert!(
                    text.contains(&format!("expected {len} bytes, found {cut} bytes")),
                    "{text}"
                );
            }
            refused += 1;
        }
        fs::write(&file, &whole).unwrap();
    }
    assert!(refused >= 200, "{refused}");
    Scene::open(&path).unwrap().verify().unwrap();
    println!("RELIABILITY F4: {refused} lengths refused, both named");
}

#[test]
fn every_flipped_bit_is_detected() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 100, 1);
    for name in FILES {
        let file = path.join(name);
        let whole = fs::read(&file).unwrap();
        let bits = whole.len() * 8;
        for i in 0..400 {
            // A stride prime to the length visits bits all over the file.
            let bit = (i * 104_729 + 11) % bits;
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            fs::write(&file, &bytes).unwrap();
            let result = Scene::open(&path).and_then(|scene| scene.verify());
            assert!(result.is_err(), "{name}, bit {bit}: undetected");
        }
        fs::write(&file, &whole).unwrap();
    }
    println!(
        "RELIABILITY F6: {} bits flipped, all of them detected",
        400 * FILES.len()
    );
}

#[test]
fn damage_is_reported_with_file_page_and_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 100, 1);
    let file = path.join("points.pages");
    let mut bytes = fs::read(&file).unwrap();
    bytes[4096 + 2 * 1024 + 5] ^= 1;
    fs::write(&file, &bytes).unwrap();
    let text = Scene::open(&path).unwrap().verify().unwrap_err().to_string();
    assert!(text.contains("corrupt point page 2: expected checksum"), "{text}");
    assert!(
        text.contains("build the scene again") && text.ends_with("city.pbgi/points.pages"),
        "{text}"
    );
}

#[test]
fn a_file_cut_or_edited_while_it_is_open_is_an_error_of_the_page() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 100, 1);
    let scene = Scene::open(&path).unwrap();
    let mut page = vec![0; scene.info().page_bytes(PageKind::Point)];
    let file = fs::OpenOptions::new()
        .write(true)
        .open(path.join("points.pages"))
        .unwrap();
    std::os::unix::fs::FileExt::write_all_at(&file, &[9], 4096 + 7).unwrap();
    file.set_len(4096 + 2 * 1024 + 10).unwrap();
    for (number, damaged) in [(0, true), (1, false), (2, true), (3, true)] {
        match scene.read_page(PageKind::Point, PageNo(number), &mut page) {
            Ok(()) => assert!(!damaged, "page {number}"),
            Err(error) => {
                assert!(damaged && matches!(error, StoreError::Corrupt { .. }), "{error}");
                assert!(error.to_string().contains(&format!("point page {number}")), "{error}");
            }
        }
    }
}

#[test]
fn files_of_different_builds_do_not_mix() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 100, 1);
    let other = dir.path().join("other.pbgi");
    write(&os_volume(), &other, Overwrite::Refuse, 100, 2).unwrap();
    fs::copy(other.join("nodes.pages"), path.join("nodes.pages")).unwrap();
    let error = Scene::open(&path).err().unwrap();
    assert!(
        matches!(error, StoreError::Mismatch { what: "build id", .. }),
        "{error}"
    );
}

#[test]
fn another_version_or_unknown_field_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 10, 1);
    let file = path.join("manifest.toml");
    let text = fs::read_to_string(&file).unwrap();
    let sealed = |body: String| {
        let sum = crc32c::crc32c(body.as_bytes());
        format!("{body}# crc32c {sum:08x}\n")
    };
    let body = text[..text.rfind("# crc32c").unwrap()].to_owned();
    assert_eq!(sealed(body.clone()), text);

    fs::write(
        &file,
        sealed(body.replace("version = 4", "version = 9\nshape = \"round\"")),
    )
    .unwrap();
    let error = Scene::open(&path).err().unwrap().to_string();
    assert!(error.contains("needs 4, the file has 9"), "{error}");

    fs::write(
        &file,
        sealed(body.replace("version = 4", "version = 4\nshape = \"round\"")),
    )
    .unwrap();
    let error = Scene::open(&path).err().unwrap().to_string();
    assert!(error.contains("unknown field `shape`"), "{error}");

    for (field, wrong) in [
        ("root = 3", "root = 30000"),
        ("nodes_per_page = 16", "nodes_per_page = 15"),
        ("node_pages = 1", "node_pages = 2"),
        ("point_count = 10", "point_count = 11"),
        ("point_count = 10", "point_count = 5000000000"),
        ("edge = 1001.75", "edge = inf"),
        ("radius_max = 0.5", "radius_max = nan"),
    ] {
        let field = if field == "root = 3" { "root = 9" } else { field };
        assert!(body.contains(field), "{field} is not in {body}");
        fs::write(&file, sealed(body.replace(field, wrong))).unwrap();
        let error = Scene::open(&path).err().unwrap_or_else(|| panic!("{wrong} opens"));
        assert!(
            matches!(error, StoreError::Corrupt { .. } | StoreError::Mismatch { .. }),
            "{error}"
        );
    }
}

#[test]
fn what_is_no_scene_is_said_to_be_none() {
    let dir = tempfile::tempdir().unwrap();
    let error = Scene::open(&dir.path().join("none.pbgi")).err().unwrap();
    assert!(matches!(error, StoreError::Missing { .. }), "{error}");
    let error = Scene::open(dir.path()).err().unwrap();
    assert!(error.to_string().contains("no manifest.toml"), "{error}");
    let file = dir.path().join("file.pbgi");
    fs::write(&file, "x").unwrap();
    let error = Scene::open(&file).err().unwrap();
    assert!(error.to_string().contains("a scene is a folder"), "{error}");
}

#[test]
fn a_fifo_in_place_of_a_file_does_not_hang() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 10, 1);
    let file = path.join("nodes.pages");
    fs::remove_file(&file).unwrap();
    nix::unistd::mkfifo(&file, nix::sys::stat::Mode::S_IRWXU).unwrap();
    let error = Scene::open(&path).err().unwrap();
    assert!(error.to_string().contains("not a regular file"), "{error}");
}

#[test]
fn a_taken_name_is_refused_and_kept() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 10, 1);
    let error = write(&os_volume(), &path, Overwrite::Refuse, 20, 2).unwrap_err();
    assert!(matches!(error, StoreError::Exists { .. }), "{error}");
    assert_eq!(Scene::open(&path).unwrap().info().point_count, 10);
    assert_eq!(names(&pbgi_store::OsVolume, dir.path()), ["city.pbgi"]);
}

#[test]
fn overwriting_replaces_in_one_step_and_leaves_open_readers_alone() {
    let dir = tempfile::tempdir().unwrap();
    let path = scene_in(dir.path(), 10, 1);
    let old = Scene::open(&path).unwrap();
    write(&os_volume(), &path, Overwrite::Replace, 100, 2).unwrap();
    assert_eq!(Scene::open(&path).unwrap().info().point_count, 100);
    assert_eq!(old.info().point_count, 10);
    old.verify().unwrap();
    assert_eq!(names(&pbgi_store::OsVolume, dir.path()), ["city.pbgi"]);
}

#[test]
fn overwriting_works_where_nothing_was() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("new.pbgi");
    write(&os_volume(), &path, Overwrite::Replace, 10, 1).unwrap();
    Scene::open(&path).unwrap();
}

#[test]
fn a_folder_that_is_no_scene_is_never_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("home.pbgi");
    fs::create_dir(&path).unwrap();
    fs::write(path.join("thesis.txt"), "years of work").unwrap();
    let error = write(&os_volume(), &path, Overwrite::Replace, 10, 1).unwrap_err();
    assert!(matches!(error, StoreError::Foreign { .. }), "{error}");
    assert_eq!(fs::read_to_string(path.join("thesis.txt")).unwrap(), "years of work");
    assert_eq!(names(&pbgi_store::OsVolume, dir.path()), ["home.pbgi"]);
}

#[test]
fn an_unfinished_scene_disappears() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("city.pbgi");
    let mut writer =
        SceneWriter::create(&os_volume(), &path, Overwrite::Refuse, &settings(), IoMode::Buffered).unwrap();
    writer.append_points(&[point(1)]).unwrap();
    assert_eq!(names(&pbgi_store::OsVolume, dir.path()).len(), 1);
    drop(writer);
    assert!(names(&pbgi_store::OsVolume, dir.path()).is_empty());
}

#[test]
fn of_many_writers_to_one_name_one_wins() {
    let dir = tempfile::tempdir().unwrap();
    for round in 0..20 {
        let path = dir.path().join(format!("{round}.pbgi"));
        let results: Vec<_> = std::thread::scope(|scope| {
            let race = |id: u32| {
                let path = &path;
                scope.spawn(move || write(&os_volume(), path, Overwrite::Refuse, 40 + id, u128::from(id)))
            };
            let racers: Vec<_> = (1..=2).map(race).collect();
            racers.into_iter().map(|racer| racer.join().unwrap()).collect()
        });
        let winners: Vec<_> = results.iter().filter_map(|result| result.as_ref().ok()).collect();
        assert_eq!(winners.len(), 1);
        let scene = Scene::open(&path).unwrap();
        assert_eq!(scene.info(), winners[0]);
        scene.verify().unwrap();
        let loser = results.iter().find_map(|result| result.as_ref().err()).unwrap();
        assert!(matches!(loser, StoreError::Exists { .. }), "{loser}");
    }
    assert_eq!(names(&pbgi_store::OsVolume, dir.path()).len(), 20);
}
