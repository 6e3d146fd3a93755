//! [`plan`]: walks the top of the tree over all sorted points and cuts the rest into jobs of whole subtrees.
//!
//! The walk is that of the construction itself, with a job's points in the place of a leaf's: a voxel that holds no more
//! of them than a job may have is somebody else's subtree, any other is opened here and closed by whoever puts the parts
//! together. So memory is bounded by the jobs in flight, whatever the cloud.

use crate::error::BuildError;
use crate::octree::subtree::{Subtree, Tallies, count_in, finalize_leaf};
use crate::sort::feed::{Feed, Piece};
use pbgi_core::limits::MORTON_BITS;
use pbgi_core::{ClusterAccumulator, PointIndex, PointRecord, Quantizer, Voxel};

/// A step of putting the tree together, in the order of the Z-curve.
#[derive(Debug)]
pub enum Step {
    /// The subtree of a voxel that holds the next points.
    Subtree {
        /// Its root.
        voxel: Voxel,
        /// Its points.
        points: usize,
    },
    /// A subtree that needs no work any more.
    Made(Box<(Subtree, Tallies)>),
    /// All children of a voxel have been told.
    Close {
        /// Their parent.
        voxel: Voxel,
        /// Which there are.
        mask: u8,
    },
}

/// A stretch of the Z-curve that can be constructed by itself.
pub struct Job {
    /// Index of its first point in the scene.
    pub first_point: u64,
    /// Its points.
    pub piece: Piece,
    /// What it consists of.
    pub steps: Vec<Step>,
}

/// Where the plan goes.
pub trait Crew {
    /// Constructs `job` and puts it together, in order.
    ///
    /// # Errors
    /// The build has ended.
    fn take(&mut self, job: Job) -> Result<(), BuildError>;

    /// Writes points that belong to a leaf that the plan makes by itself.
    ///
    /// # Errors
    /// The build has ended.
    fn write(&mut self, points: Vec<PointRecord>) -> Result<(), BuildError>;
}

/// Cuts everything that `feed` has into jobs of at most `2 * job_points` points.
///
/// # Errors
/// Those of the feed and of the crew.
pub fn plan(
    feed: Feed<'_>,
    crew: &mut dyn Crew,
    quantizer: &Quantizer,
    leaf_max: usize,
    job_points: usize,
) -> Result<(), BuildError> {
    let mut plan = Plan {
        feed,
        crew,
        quantizer,
        leaf_max,
        // A voxel of the deepest level that is not streamed is a leaf of one job.
        job_points: job_points.max(leaf_max),
        planned: 0,
        first_point: 0,
        steps: Vec::new(),
    };
    plan.voxel(Voxel::ROOT)?;
    plan.send()
}

struct Plan<'a, 's> {
    feed: Feed<'s>,
    crew: &'a mut dyn Crew,
    quantizer: &'a Quantizer,
    leaf_max: usize,
    job_points: usize,
    /// Points at the front of the feed that the steps use up.
    planned: usize,
    /// Index of the point at the front of the feed.
    first_point: u64,
    steps: Vec<Step>,
}

impl Plan<'_, '_> {
    /// The codes behind those planned: `job_points + 1` of them, fewer at the end.
    fn ahead(&mut self) -> Result<&[u64], BuildError> {
        let wanted = self.planned + self.job_points + 1;
        let codes = self.feed.codes(wanted)?;
        Ok(&codes[self.planned..wanted.min(codes.len())])
    }

    /// Plans what lies in `voxel`; whether there was anything.
    fn voxel(&mut self, voxel: Voxel) -> Result<bool, BuildError> {
        let job_points = self.job_points;
        let count = count_in(self.ahead()?, voxel);
        if count == 0 {
            return Ok(false);
        }
        if count <= job_points {
            self.steps.push(Step::Subtree { voxel, points: count });
            self.planned += count;
            if self.planned >= job_points {
                self.send()?;
            }
        } else if voxel.level == MORTON_BITS {
            self.stream_leaf(voxel)?;
        } else {
            let mut mask = 0;
            for octant in 0..8 {
                if self.voxel(voxel.child(octant))? {
                    mask |= 1 << octant;
                }
            }
            self.steps.push(Step::Close { voxel, mask });
        }
        Ok(true)
    }

    /// A leaf of the deepest level with more points than a job: any number of them. Its sum is made in the order of the
    /// points, as in any other leaf, so that it does not depend on the size of a job.
    fn stream_leaf(&mut self, voxel: Voxel) -> Result<(), BuildError> {
        self.send()?;
        let first = PointIndex(self.first_point as u32);
        let mut sum = ClusterAccumulator::default();
        loop {
            let count = count_in(self.ahead()?, voxel).min(self.job_points);
            if count == 0 {
                break;
            }
            let points = self.feed.take(count).points;
            points.iter().for_each(|point| sum.add(point, self.quantizer));
            self.first_point += count as u64;
            self.crew.write(points)?;
        }
        let mut tallies = Tallies::default();
        let leaf = finalize_leaf(voxel, first, sum, self.leaf_max, self.quantizer, &mut tallies);
        self.steps.push(Step::Made(Box::new((leaf, tallies))));
        Ok(())
    }

    fn send(&mut self) -> Result<(), BuildError> {
        if self.steps.is_empty() {
            return Ok(());
        }
        let job = Job {
            first_point: self.first_point,
            piece: self.feed.take(self.planned),
            steps: std::mem::take(&mut self.steps),
        };
        self.first_point += self.planned as u64;
        self.planned = 0;
        self.crew.take(job)
    }
}
