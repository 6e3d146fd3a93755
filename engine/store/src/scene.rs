//! [`Scene`]: a published octree, open for reading.

use crate::error::StoreError;
use crate::limits::RACE_ATTEMPTS;
use crate::manifest::{self, MANIFEST_NAME};
use crate::os_volume::OsVolume;
use crate::page_header::PageLayout;
use crate::page_reader::PageFile;
use crate::volume::{EntryKind, Volume};
use pbgi_core::{PageKind, PageNo, SceneInfo};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Name of the node file in a scene's folder.
pub const NODES_NAME: &str = "nodes.pages";

/// Name of the point file in a scene's folder.
pub const POINTS_NAME: &str = "points.pages";

/// An open scene: everything but the content of its pages has been checked, and its files stay open, so a scene that
/// takes its name later does not disturb it. Pages may be read from any thread.
pub struct Scene {
    info: SceneInfo,
    nodes: PageFile,
    points: PageFile,
    path: PathBuf,
}

impl Scene {
    /// Opens the folder `NAME.pbgi`.
    ///
    /// # Errors
    /// [`StoreError::Missing`], [`StoreError::Foreign`] if it is no scene, [`StoreError::Mismatch`] for another version
    /// or files of different builds, [`StoreError::Corrupt`] for damage, [`StoreError::Io`].
    pub fn open(path: &Path) -> Result<Self, StoreError> {
        Self::open_on(&(Arc::new(OsVolume) as Arc<dyn Volume>), path)
    }

    /// As [`Self::open`], on any volume.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_on(volume: &Arc<dyn Volume>, path: &Path) -> Result<Self, StoreError> {
        let mut attempts = 1;
        loop {
            match Self::try_open(volume, path) {
                // The folder may just have been exchanged for another one.
                Err(StoreError::Mismatch { what: BUILD_ID, .. }) if attempts < RACE_ATTEMPTS => attempts += 1,
                Err(StoreError::Io { source, .. })
                    if source.kind() == io::ErrorKind::NotFound && attempts < RACE_ATTEMPTS =>
                {
                    attempts += 1;
                }
                result => return result,
            }
        }
    }

    fn try_open(volume: &Arc<dyn Volume>, path: &Path) -> Result<Self, StoreError> {
        match volume.kind(path) {
            Ok(Some(EntryKind::Folder | EntryKind::Other)) => {}
            Ok(Some(EntryKind::File)) => return Err(not_a_scene(path, "a scene is a folder, this is a file")),
            Ok(None) => return Err(StoreError::Missing { path: path.to_owned() }),
            Err(error) => return Err(StoreError::io("open scene", path, error)),
        }
        let manifest_path = path.join(MANIFEST_NAME);
        if volume.kind(&manifest_path).is_ok_and(|kind| kind.is_none()) {
            return Err(not_a_scene(path, "no scene, because the folder has no manifest.toml"));
        }
        let info = manifest::read(volume, &manifest_path)?;
        let nodes = PageFile::open(volume, &path.join(NODES_NAME), PageKind::Node)?;
        let points = PageFile::open(volume, &path.join(POINTS_NAME), PageKind::Point)?;
        check_file(&info, &nodes, PageKind::Node, info.node_slots)?;
        check_file(&info, &points, PageKind::Point, info.point_count)?;
        Ok(Self {
            info,
            nodes,
            points,
            path: path.to_owned(),
        })
    }

    /// Counts, lattice and layout.
    pub fn info(&self) -> &SceneInfo {
        &self.info
    }

    /// The folder's name when it was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads a page and checks its sum; `out` has exactly [`SceneInfo::page_bytes`] bytes.
    ///
    /// # Errors
    /// [`StoreError::PageRange`], [`StoreError::Corrupt`] naming file and page, [`StoreError::Io`];
    /// [`StoreError::Invalid`] for a buffer of another length. The content of `out` is then unspecified.
    pub fn read_page(&self, kind: PageKind, page: PageNo, out: &mut [u8]) -> Result<(), StoreError> {
        match kind {
            PageKind::Node => self.nodes.read_page(page, out),
            PageKind::Point => self.points.read_page(page, out),
        }
    }

    /// Has the operating system begin to read a page that will be read soon; returns at once.
    pub fn will_need(&self, kind: PageKind, page: PageNo) {
        match kind {
            PageKind::Node => self.nodes.will_need(page),
            PageKind::Point => self.points.will_need(page),
        }
    }

    /// Reads every page once and checks its sum.
    ///
    /// # Errors
    /// As [`Self::read_page`], for the first page that fails.
    pub fn verify(&self) -> Result<(), StoreError> {
        for kind in [PageKind::Node, PageKind::Point] {
            let mut page = vec![0; self.info.page_bytes(kind)];
            for number in 0..self.info.page_count(kind) {
                self.read_page(kind, PageNo(number as u32), &mut page)?;
            }
        }
        Ok(())
    }
}

const BUILD_ID: &str = "build id";

fn not_a_scene(path: &Path, reason: &str) -> StoreError {
    StoreError::Foreign {
        reason: reason.to_owned(),
        path: path.to_owned(),
    }
}

/// Whether a page file belongs to the manifest.
fn check_file(info: &SceneInfo, file: &PageFile, kind: PageKind, records: u64) -> Result<(), StoreError> {
    let (header, path) = (file.header(), file.path());
    if header.build_id != info.build_id {
        return Err(StoreError::mismatch(path, BUILD_ID, info.build_id, header.build_id));
    }
    let expected = PageLayout::new(kind, &info.settings).records_per_page;
    let actual = header.layout.records_per_page;
    if actual != expected {
        return Err(StoreError::mismatch(path, "page size", expected, actual));
    }
    if header.record_count != records {
        let count = |count: u64| format!("{count} records");
        return Err(StoreError::corrupt(
            path,
            "header",
            count(records),
            count(header.record_count),
        ));
    }
    Ok(())
}
