//! Frames and the word that says what a frame holds.

use pbgi_core::{MountId, PageKey, PageNo};

/// Number of a frame within the pool of its page's kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct FrameId(pub u32);

/// What is going on in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TagState {
    /// Holds no page.
    Empty,
    /// The owner is writing the page of this key.
    Loading,
    /// Holds the page of this key; may be pinned.
    Resident,
    /// Holds the page of this key while the owner looks for pins.
    Evicting,
    /// Holds a page of a scene that is no longer mounted; stays as it is until its last pin is gone.
    Doomed,
}

/// A frame's tag: `[state 8][mount slot 8][mount generation 16][page 32]`, so that one comparison settles whether the
/// frame holds a page, and a frame reused for another scene never compares equal. The page's kind is that of the
/// pool.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Tag(pub u64);

const STATE_SHIFT: u32 = 56;
const SLOT_SHIFT: u32 = 48;
const GENERATION_SHIFT: u32 = 32;
const KEY_MASK: u64 = (1 << STATE_SHIFT) - 1;

impl Tag {
    /// The tag of a frame that holds nothing; also what fresh shared memory contains.
    pub const EMPTY: Self = Self(0);

    /// The tag of a frame that holds this page.
    #[inline(always)]
    pub const fn resident(key: PageKey) -> Self {
        Self(
            (TagState::Resident as u64) << STATE_SHIFT
                | (key.mount.slot as u64) << SLOT_SHIFT
                | (key.mount.generation as u64) << GENERATION_SHIFT
                | key.page.0 as u64,
        )
    }

    /// The same page in another state.
    #[inline(always)]
    pub const fn with_state(self, state: TagState) -> Self {
        Self((state as u64) << STATE_SHIFT | self.0 & KEY_MASK)
    }

    /// The state; a word that is no state of ours reads as empty.
    pub const fn state(self) -> TagState {
        match self.0 >> STATE_SHIFT {
            1 => TagState::Loading,
            2 => TagState::Resident,
            3 => TagState::Evicting,
            4 => TagState::Doomed,
            _ => TagState::Empty,
        }
    }

    /// The scene of the page.
    pub const fn mount(self) -> MountId {
        MountId {
            slot: (self.0 >> SLOT_SHIFT) as u8,
            generation: (self.0 >> GENERATION_SHIFT) as u16,
        }
    }

    /// The page.
    pub const fn page(self) -> PageNo {
        PageNo(self.0 as u32)
    }

    /// Whether both name the same page, whatever the states.
    #[inline]
    pub const fn same_page(self, other: Self) -> bool {
        (self.0 ^ other.0) & KEY_MASK == 0
    }

    /// 32 well-mixed bits of the page's identity (the finalizer of SplitMix64), the same in every process.
    #[inline(always)]
    pub const fn hash32(self) -> u32 {
        let mut x = self.0 & KEY_MASK;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (x >> 32) as u32
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use pbgi_core::PageKind;

    #[test]
    fn tag_carries_every_part_of_the_key() {
        let mount = MountId {
            slot: 63,
            generation: 0xfffe,
        };
        let key = PageKey {
            mount,
            kind: PageKind::Node,
            page: PageNo(0xdead_beef),
        };
        let tag = Tag::resident(key);
        assert_eq!(
            (tag.state(), tag.mount(), tag.page()),
            (TagState::Resident, mount, key.page)
        );
        for state in [
            TagState::Empty,
            TagState::Loading,
            TagState::Resident,
            TagState::Evicting,
            TagState::Doomed,
        ] {
            assert_eq!(tag.with_state(state).state(), state);
            assert!(tag.with_state(state).same_page(tag));
        }
        let later = PageKey {
            mount: MountId {
                generation: 0xffff,
                ..mount
            },
            ..key
        };
        assert_ne!(Tag::resident(later), tag);
        assert!(!Tag::resident(later).same_page(tag));
        assert_eq!(Tag::EMPTY.state(), TagState::Empty);
    }
}
