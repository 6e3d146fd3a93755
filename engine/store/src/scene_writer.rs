//! [`SceneWriter`]: builds a scene under a temporary name and publishes it in one step.

use crate::atomic_file::Overwrite;
use crate::data_file::{DataFile, write_error};
use crate::error::StoreError;
use crate::limits::SCENE_MODE;
use crate::manifest::{self, MANIFEST_NAME};
use crate::page_header::PageLayout;
use crate::page_writer::PageFileWriter;
use crate::scene::{NODES_NAME, POINTS_NAME};
use crate::temporary::{
    check_replaceable, create_locked, publish, remove_temporary, sweep_temporaries, temporary_path,
};
use crate::volume::{IoMode, Lock, Volume};
use pbgi_core::{BuildSettings, NodeIndex, NodeRecord, PageKind, PointIndex, PointRecord, SceneInfo};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A scene that is being written, in a folder `NAME.pbgi.tmp-<hex>` beside its target. Dropping it unpublished deletes
/// it.
pub struct SceneWriter {
    // Fields drop in this order: the files are closed before the folder goes.
    nodes: PageFileWriter,
    points: PageFileWriter,
    folder: TemporaryFolder,
    target: PathBuf,
    overwrite: Overwrite,
}

/// The temporary folder, locked while its owner lives, deleted on drop.
struct TemporaryFolder {
    volume: Arc<dyn Volume>,
    path: PathBuf,
    _lock: Lock,
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        // A leftover is swept by the next writer of the same name.
        let _ = remove_temporary(self.volume.as_ref(), &self.path);
    }
}

impl SceneWriter {
    /// Creates the temporary folder and its files. The settings fix the page sizes; `mode` is for the pages.
    ///
    /// # Errors
    /// [`StoreError::Exists`] if `output` is taken and `overwrite` refuses, [`StoreError::Foreign`] if it is taken by
    /// something that is no scene, [`StoreError::NoSpace`], [`StoreError::Io`].
    pub fn create(
        volume: &Arc<dyn Volume>,
        output: &Path,
        overwrite: Overwrite,
        settings: &BuildSettings,
        mode: IoMode,
    ) -> Result<Self, StoreError> {
        let kind = volume
            .kind(output)
            .map_err(|error| StoreError::io("inspect", output, error))?;
        if kind.is_some() && overwrite == Overwrite::Refuse {
            return Err(StoreError::Exists {
                path: output.to_owned(),
            });
        }
        sweep_temporaries(volume.as_ref(), output)?;
        let (path, lock, ()) = create_locked(
            volume.as_ref(),
            || temporary_path(output),
            |temporary| volume.create_dir(temporary, SCENE_MODE),
        )?;
        let folder = TemporaryFolder {
            volume: volume.clone(),
            path,
            _lock: lock,
        };
        // Says now what publishing would say after the work is done.
        check_replaceable(volume.as_ref(), &folder.path, output)?;
        let file = |name, kind| {
            let layout = PageLayout::new(kind, settings);
            PageFileWriter::create(volume, &folder.path.join(name), layout, mode)
        };
        Ok(Self {
            nodes: file(NODES_NAME, PageKind::Node)?,
            points: file(POINTS_NAME, PageKind::Point)?,
            folder,
            target: output.to_owned(),
            overwrite,
        })
    }

    /// Bytes that may still be written where the scene is.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn free_bytes(&self) -> Result<u64, StoreError> {
        let path = &self.folder.path;
        let free = self.folder.volume.free_bytes(path);
        free.map_err(|error| StoreError::io("read free space", path, error))
    }

    /// Where the scene will be.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Points appended so far.
    pub fn point_count(&self) -> u64 {
        self.points.slots()
    }

    /// Node slots taken so far, padding included.
    pub fn node_slots(&self) -> u64 {
        self.nodes.slots()
    }

    /// Kind and sizes of node pages; [`PageLayout::group_slot`] tells where a sibling group will go.
    pub fn node_layout(&self) -> &PageLayout {
        self.nodes.layout()
    }

    /// Appends points; returns the index of the first one.
    ///
    /// # Errors
    /// As [`PageFileWriter::append`].
    pub fn append_points(&mut self, points: &[PointRecord]) -> Result<PointIndex, StoreError> {
        Ok(PointIndex(self.points.append(points)? as u32))
    }

    /// Appends the children of one node, or the root alone; returns the index of the first one.
    ///
    /// # Errors
    /// As [`PageFileWriter::append_group`].
    pub fn append_siblings(&mut self, siblings: &[NodeRecord]) -> Result<NodeIndex, StoreError> {
        Ok(NodeIndex(self.nodes.append_group(siblings)? as u32))
    }

    /// Writes the manifest, makes everything durable and gives the folder its name. Returns the bytes of all files.
    /// What had the name before is deleted; if that fails, the next writer of the same name does it.
    ///
    /// # Errors
    /// [`StoreError::Exists`] if the name was taken meanwhile and `overwrite` refuses; [`StoreError::Invalid`] if
    /// `info` does not describe what was appended; [`StoreError::NoSpace`], [`StoreError::Io`]. Nothing is left behind
    /// then.
    pub fn finish(self, info: &SceneInfo) -> Result<u64, StoreError> {
        let written = (self.points.slots(), self.nodes.slots());
        if written != (info.point_count, info.node_slots) {
            return Err(StoreError::Invalid(format!(
                "the manifest counts {} points and {} node slots, {} and {} were written",
                info.point_count, info.node_slots, written.0, written.1
            )));
        }
        let folder = self.folder;
        let mut bytes = self.nodes.finish(info.build_id)? + self.points.finish(info.build_id)?;
        let manifest_path = folder.path.join(MANIFEST_NAME);
        let text = manifest::encode(info, &manifest_path)?;
        let manifest = DataFile::create_new(&folder.volume, &manifest_path, IoMode::Buffered)?;
        manifest.write_at(0, text.as_bytes())?;
        manifest.sync()?;
        bytes += text.len() as u64;
        let volume = folder.volume.as_ref();
        let synced = volume.sync_dir(&folder.path);
        synced.map_err(|error| write_error(volume, "sync folder", &folder.path, 0, error))?;
        publish(volume, &folder.path, &self.target, self.overwrite)?;
        Ok(bytes)
        // Dropping the folder deletes what has the temporary name now: the old scene, or nothing.
    }
}
