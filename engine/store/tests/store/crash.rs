//! Power is lost at every event of a publish, with everything unsynced dropped or torn: the name then stands for the
//! old scene, the new one, or nothing where nothing was, and a file that opens is whole.

use crate::support::{names, write};
use pbgi_store::testsuite::{CrashImage, CrashVolume};
use pbgi_store::{AtomicFile, DataFile, Overwrite, Scene, StoreError, Volume, sweep_temporaries};
use std::io::Write;
use std::path::Path;
use std::sync::Arc;

const TORN_IMAGES: u64 = 40;

fn images() -> impl Iterator<Item = CrashImage> {
    std::iter::once(CrashImage::Durable).chain((0..TORN_IMAGES).map(CrashImage::Torn))
}

/// Points of the scene that the next start finds, `None` if there is none.
fn survivor(volume: &Arc<dyn Volume>, path: &Path) -> Option<u64> {
    match Scene::open_on(volume, path) {
        Ok(scene) => {
            scene.verify().unwrap();
            Some(scene.info().point_count)
        }
        Err(StoreError::Missing { .. }) => None,
        Err(error) => panic!("an invalid scene has the name: {error}"),
    }
}

#[test]
fn a_new_scene_is_there_whole_or_not_at_all() {
    let path = Path::new("/city.pbgi");
    let mut crashes = 0;
    for crash_at in 1.. {
        let disk = CrashVolume::new(Some(crash_at));
        let result = write(&(Arc::new(disk.clone()) as _), path, Overwrite::Refuse, 100, 1);
        if !disk.crashed() {
            result.unwrap();
            break;
        }
        crashes += 1;
        for image in images() {
            let next: Arc<dyn Volume> = Arc::new(disk.after_crash(image));
            let found = survivor(&next, path);
            assert!(
                matches!(found, None | Some(100)),
                "event {crash_at}, {image:?}: {found:?}"
            );
            sweep_temporaries(next.as_ref(), path).unwrap();
            let expected: &[&str] = if found.is_some() { &["city.pbgi"] } else { &[] };
            assert_eq!(names(next.as_ref(), Path::new("/")), expected);
        }
    }
    assert!(crashes >= 10, "{crashes}");
}

#[test]
fn an_overwritten_scene_is_the_old_or_the_new_one() {
    let path = Path::new("/city.pbgi");
    for crash_at in 1.. {
        let disk = CrashVolume::new(None);
        let volume: Arc<dyn Volume> = Arc::new(disk.clone());
        write(&volume, path, Overwrite::Refuse, 50, 1).unwrap();
        disk.arm(Some(crash_at));
        let result = write(&volume, path, Overwrite::Replace, 100, 2);
        if !disk.crashed() {
            result.unwrap();
            assert_eq!(survivor(&volume, path), Some(100));
            break;
        }
        for image in images() {
            let next: Arc<dyn Volume> = Arc::new(disk.after_crash(image));
            let found = survivor(&next, path);
            assert!(
                matches!(found, Some(50 | 100)),
                "event {crash_at}, {image:?}: {found:?}"
            );
        }
    }
}

#[test]
fn an_atomic_file_is_the_old_or_the_new_one() {
    let path = Path::new("/out.exr");
    let content = |fill: u8| vec![fill; 10_000];
    let publish = |volume: &Arc<dyn Volume>, fill| {
        let mut file = AtomicFile::create_on(volume, path, Overwrite::Replace)?;
        file.write_all(&content(fill))
            .map_err(|error| StoreError::Invalid(error.to_string()))?;
        file.publish()
    };
    for crash_at in 1.. {
        let disk = CrashVolume::new(None);
        let volume: Arc<dyn Volume> = Arc::new(disk.clone());
        publish(&volume, 1).unwrap();
        disk.arm(Some(crash_at));
        let result = publish(&volume, 2);
        if !disk.crashed() {
            result.unwrap();
            break;
        }
        for image in images() {
            let next: Arc<dyn Volume> = Arc::new(disk.after_crash(image));
            let file = DataFile::open(&next, path).unwrap();
            let mut bytes = vec![0; file.byte_len().unwrap() as usize];
            file.read_at(0, &mut bytes, &|| "file".to_owned()).unwrap();
            assert!(
                bytes == content(1) || bytes == content(2),
                "event {crash_at}, {image:?}"
            );
        }
    }
}
