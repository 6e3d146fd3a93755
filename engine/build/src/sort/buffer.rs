//! [`PointBuffer`]: points in memory, in the order of arrival, in blocks that are sorted in place of each other.

use pbgi_core::PointRecord;

/// Points in a block: 8 KiB, so that a block for each of a thousand buckets fits the caches and wastes little at its end.
pub const BLOCK_POINTS: usize = 256;

/// Points side by side. Never longer than [`BLOCK_POINTS`], so that it never moves.
pub type Block = Vec<PointRecord>;

/// Blocks whose content has moved on, to be filled again.
#[derive(Default)]
pub struct SpareBlocks(Vec<Block>);

impl SpareBlocks {
    /// An empty block.
    pub fn take(&mut self) -> Block {
        self.0.pop().unwrap_or_else(|| Vec::with_capacity(BLOCK_POINTS))
    }

    /// Keeps the memory of a block.
    pub fn give(&mut self, mut block: Block) {
        block.clear();
        self.0.push(block);
    }

    /// How many there are.
    #[cfg(test)]
    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// Keeps all that another one has.
    pub fn merge(&mut self, other: Self) {
        self.0.extend(other.0);
    }
}

/// Points in the order of arrival, never more than `capacity`. Memory is taken as they arrive.
pub struct PointBuffer {
    blocks: Vec<Block>,
    spare: SpareBlocks,
    len: usize,
    capacity: usize,
}

impl PointBuffer {
    /// An empty buffer.
    pub fn new(capacity: usize) -> Self {
        Self::with_spare(SpareBlocks::default(), capacity)
    }

    /// An empty buffer that fills these blocks before it takes others.
    pub fn with_spare(spare: SpareBlocks, capacity: usize) -> Self {
        Self {
            blocks: Vec::new(),
            spare,
            len: 0,
            capacity: capacity.max(1),
        }
    }

    /// Points in it.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Most points it holds.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// How many more there is room for.
    pub fn room(&self) -> usize {
        self.capacity - self.len
    }

    /// Appends points; the caller sees to the room.
    pub fn extend(&mut self, mut points: &[PointRecord]) {
        debug_assert!(points.len() <= self.room());
        self.len += points.len();
        while !points.is_empty() {
            let block = match self.blocks.last_mut() {
                Some(block) if block.len() < BLOCK_POINTS => block,
                _ => {
                    self.blocks.push(self.spare.take());
                    continue;
                }
            };
            let (head, tail) = points.split_at((BLOCK_POINTS - block.len()).min(points.len()));
            block.extend_from_slice(head);
            points = tail;
        }
    }

    /// Forgets the points, keeps the memory.
    pub fn clear(&mut self) {
        self.blocks.drain(..).for_each(|block| self.spare.give(block));
        self.len = 0;
    }

    /// The points, and memory to sort them with.
    pub fn into_blocks(self) -> (Vec<Block>, SpareBlocks) {
        (self.blocks, self.spare)
    }
}
