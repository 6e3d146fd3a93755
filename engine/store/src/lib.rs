//! Bytes on disk: scene folders, page files and sort runs, each checksummed, published whole or not at all, and swept
//! when a process dies.
//!
//! Start at [`Scene`] to read a built octree, at [`SceneWriter`] to write one, at [`AtomicFile`] for any other output
//! file. All of them reach the disk through [`Volume`] and [`Storage`], so that the doubles of `testsuite` (a feature)
//! can fail or crash any operation. The formats are drawn in `docs/format.md`. Nothing here is ever
//! mapped into memory, and nothing here knows what points and nodes mean.
#![forbid(unsafe_code)]

#[cfg(target_endian = "big")]
compile_error!("scene files are little-endian and are read without conversion");

pub mod atomic_file;
pub mod data_file;
pub mod error;
mod file_writer;
pub mod limits;
pub mod manifest;
pub mod os_volume;
pub mod page_header;
pub mod page_reader;
pub mod page_writer;
pub mod run;
pub mod run_reader;
pub mod run_writer;
pub mod scene;
pub mod scene_writer;
pub mod scratch;
mod sector_buffer;
pub mod shape;
pub mod temporary;
#[cfg(any(test, feature = "testsuite"))]
pub mod testsuite;
pub mod volume;
mod write_behind;

pub use atomic_file::{AtomicFile, Overwrite};
pub use data_file::DataFile;
pub use error::StoreError;
pub use os_volume::OsVolume;
pub use page_header::PageLayout;
pub use page_reader::PageFile;
pub use page_writer::PageFileWriter;
pub use run::Run;
pub use run_reader::RunReader;
pub use run_writer::RunWriter;
pub use scene::Scene;
pub use scene_writer::SceneWriter;
pub use scratch::{ScratchDir, Sweep, sweep_scratch};
pub use shape::{LevelShape, SceneShape};
pub use temporary::sweep_temporaries;
pub use volume::{EntryKind, IoMode, RenameMode, Storage, Volume};
