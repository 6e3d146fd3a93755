//! What dead processes left is swept; what belongs to others, or to the living, stays.

use crate::support::{names, os_volume, point, write};
use pbgi_store::limits::RUN_BLOCK_RECORDS;
use pbgi_store::{
    AtomicFile, OsVolume, Overwrite, RunReader, RunWriter, Scene, ScratchDir, StoreError, sweep_scratch,
    sweep_temporaries,
};
use std::fs;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::PermissionsExt;

#[test]
fn an_atomic_file_appears_when_it_is_published() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out.exr");
    let mut file = AtomicFile::create(&path, Overwrite::Refuse).unwrap();
    let mut buffered = BufWriter::new(&mut file);
    buffered.write_all(b"hello world").unwrap();
    buffered.seek(SeekFrom::Start(6)).unwrap();
    buffered.write_all(b"there").unwrap();
    buffered.flush().unwrap();
    drop(buffered);
    file.seek(SeekFrom::Start(0)).unwrap();
    let mut text = String::new();
    file.read_to_string(&mut text).unwrap();
    assert_eq!(text, "hello there");
    assert!(!names(&OsVolume, dir.path()).contains(&"out.exr".to_owned()));
    file.publish().unwrap();
    assert_eq!(names(&OsVolume, dir.path()), ["out.exr"]);
    assert_eq!(fs::read(&path).unwrap(), b"hello there");
    let mode = fs::metadata(&path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode & !0o640, 0, "{mode:o}");
}

#[test]
fn an_atomic_file_replaces_only_files_and_only_when_asked() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out.exr");
    fs::write(&path, "old").unwrap();
    assert!(matches!(
        AtomicFile::create(&path, Overwrite::Refuse),
        Err(StoreError::Exists { .. })
    ));
    let mut file = AtomicFile::create(&path, Overwrite::Replace).unwrap();
    file.write_all(b"new").unwrap();
    assert_eq!(fs::read(&path).unwrap(), b"old");
    file.publish().unwrap();
    assert_eq!(fs::read(&path).unwrap(), b"new");
    assert!(matches!(
        AtomicFile::create(dir.path(), Overwrite::Replace),
        Err(StoreError::Foreign { .. })
    ));
    assert_eq!(names(&OsVolume, dir.path()), ["out.exr"]);
}

#[test]
fn a_name_taken_while_writing_is_not_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out.exr");
    let file = AtomicFile::create(&path, Overwrite::Refuse).unwrap();
    fs::write(&path, "theirs").unwrap();
    assert!(matches!(file.publish(), Err(StoreError::Exists { .. })));
    assert_eq!(fs::read(&path).unwrap(), b"theirs");
    assert_eq!(names(&OsVolume, dir.path()), ["out.exr"]);
}

#[test]
fn leftovers_of_the_same_output_are_swept_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("city.pbgi");
    let digits = "0123456789abcdef";
    let leftovers = [
        format!("city.pbgi.tmp-{digits}"),
        "city.pbgi.tmp-00000000000000aa".to_owned(),
    ];
    for name in &leftovers {
        fs::create_dir(dir.path().join(name)).unwrap();
        fs::write(dir.path().join(name).join("nodes.pages"), "half").unwrap();
    }
    let decoys = [
        format!("other.pbgi.tmp-{digits}"),
        "city.pbgi.tmp-0123".to_owned(),
        "city.pbgi.tmp-0123456789ABCDEF".to_owned(),
        format!("city.pbgi.tmp-{digits}0"),
        format!("xcity.pbgi.tmp-{digits}"),
        "city.pbgi.bak".to_owned(),
        "city".to_owned(),
    ];
    for name in &decoys {
        fs::create_dir(dir.path().join(name)).unwrap();
    }
    let foreign = dir.path().join("city.pbgi.tmp-ffffffffffffffff");
    fs::create_dir(&foreign).unwrap();
    fs::write(foreign.join("letter.txt"), "mine").unwrap();
    let living = AtomicFile::create(&path, Overwrite::Refuse).unwrap();

    write(&os_volume(), &path, Overwrite::Refuse, 10, 1).unwrap();
    assert_eq!(sweep_temporaries(&OsVolume, &path).unwrap(), 0);
    let left = names(&OsVolume, dir.path());
    assert!(leftovers.iter().all(|name| !left.contains(name)), "{left:?}");
    assert!(decoys.iter().all(|name| left.contains(name)), "{left:?}");
    assert!(foreign.join("letter.txt").is_file());
    // The decoys, the foreign folder, the living temporary, the scene.
    assert_eq!(left.len(), decoys.len() + 3, "{left:?}");
    drop(living);
    Scene::open(&path).unwrap();
    println!(
        "RELIABILITY F12: {} leftovers swept, {} others stay",
        leftovers.len(),
        decoys.len() + 2
    );
}

#[test]
fn scratch_of_the_dead_is_swept_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let volume = os_volume();
    let digits = "0123456789abcde";
    for i in 0..10 {
        let folder = dir.path().join(format!("pbgi-scratch-{digits}{i:x}"));
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("run-000000"), [0; 100]).unwrap();
    }
    let decoys = [
        "pbgi-scratch-",
        "pbgi-scratch-0123",
        "my-scratch",
        "run-000000",
        "Pbgi-scratch-0123456789abcdef",
    ];
    for name in decoys {
        fs::create_dir(dir.path().join(name)).unwrap();
    }
    fs::write(dir.path().join("pbgi-scratch-ffffffffffffffff"), "a file").unwrap();
    let mixed = dir.path().join("pbgi-scratch-eeeeeeeeeeeeeeee");
    fs::create_dir(&mixed).unwrap();
    fs::write(mixed.join("notes.txt"), "mine").unwrap();
    let living = ScratchDir::create(&volume, dir.path()).unwrap();
    let run = RunWriter::create(&living, 0).unwrap();

    let sweep = sweep_scratch(&OsVolume, dir.path()).unwrap();
    assert_eq!((sweep.folders, sweep.bytes), (10, 1000));
    assert_eq!(names(&OsVolume, dir.path()).len(), decoys.len() + 3);
    assert!(mixed.join("notes.txt").is_file());
    assert!(living.path().join("run-000000").is_file());
    drop(run);
    drop(living);
    assert_eq!(names(&OsVolume, dir.path()).len(), decoys.len() + 2);
}

#[test]
fn a_run_comes_back_in_order_and_is_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let scratch = ScratchDir::create(&os_volume(), dir.path()).unwrap();
    for (number, count) in [0, 1, RUN_BLOCK_RECORDS, 2 * RUN_BLOCK_RECORDS + 5]
        .into_iter()
        .enumerate()
    {
        let mut writer = RunWriter::create(&scratch, number as u64).unwrap();
        let points: Vec<_> = (0..count).map(|i| point(i as u32)).collect();
        // In parts that know nothing of blocks.
        points.chunks(1000).for_each(|some| writer.append(some).unwrap());
        let run = writer.finish().unwrap();
        assert_eq!(run.records(), count as u64);
        let mut reader = RunReader::new(vec![run], 2).unwrap();
        let mut read = Vec::new();
        while !reader.records(0).is_empty() {
            read.extend_from_slice(reader.records(0));
            reader.advance(0).unwrap();
        }
        assert!(read == points);
        drop(reader);
        assert!(names(&OsVolume, scratch.path()).is_empty());
    }
}

#[test]
fn a_damaged_run_is_detected() {
    let dir = tempfile::tempdir().unwrap();
    let scratch = ScratchDir::create(&os_volume(), dir.path()).unwrap();
    let mut writer = RunWriter::create(&scratch, 0).unwrap();
    let points: Vec<_> = (0..100).map(point).collect();
    writer.append(&points).unwrap();
    let run = writer.finish().unwrap();
    let file = scratch.path().join("run-000000");
    let mut bytes = fs::read(&file).unwrap();
    bytes[1000] ^= 4;
    fs::write(&file, &bytes).unwrap();
    let error = RunReader::new(vec![run], 1).err().unwrap();
    assert!(matches!(error, StoreError::Corrupt { .. }), "{error}");
}
