//! Whose frame a load takes: scenes share a pool fairly when more than one needs room (Rule 12).

/// What a scene has of a pool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Holding {
    /// Number of its mount.
    pub(crate) slot: u8,
    /// Frames that hold its pages.
    pub(crate) frames: u32,
    /// Whether it asked for pages of late.
    pub(crate) at_work: bool,
}

/// Where a load looks for a victim first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Room {
    /// Among the pages of one scene.
    Of(u8),
    /// Anywhere.
    Anywhere,
}

/// Share of a pool that a scene leaves to pages of scenes that rest: one in this many frames.
const RESERVED: u32 = 8;

/// Where a load for `slot` looks first, in a pool of `frames` frames.
pub(crate) fn room(frames: u32, slot: u8, holdings: &[Holding]) -> Room {
    let own = holdings
        .iter()
        .find(|holding| holding.slot == slot)
        .map_or(0, |own| own.frames);
    let others = || {
        holdings
            .iter()
            .filter(|holding| holding.slot != slot && holding.frames > 0)
    };
    let at_work = 1 + others().filter(|holding| holding.at_work).count() as u32;
    let resting: u32 = others()
        .filter(|holding| !holding.at_work)
        .map(|holding| holding.frames)
        .sum();
    let quota = (frames - resting.min(frames / RESERVED)) / at_work;
    if own >= quota.max(1) && others().next().is_some() {
        return Room::Of(slot);
    }
    let above = others().filter(|holding| holding.at_work && holding.frames > quota);
    above
        .max_by_key(|holding| (holding.frames, holding.slot))
        .map_or(Room::Anywhere, |holding| Room::Of(holding.slot))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holding(slot: u8, frames: u32, at_work: bool) -> Holding {
        Holding { slot, frames, at_work }
    }

    #[test]
    fn scene_alone_takes_all() {
        assert_eq!(room(100, 1, &[holding(1, 100, true)]), Room::Anywhere);
        assert_eq!(room(100, 1, &[]), Room::Anywhere);
        assert_eq!(
            room(100, 1, &[holding(1, 100, true), holding(2, 0, false)]),
            Room::Anywhere
        );
    }

    #[test]
    fn scenes_at_work_have_equal_parts() {
        let both = [holding(1, 70, true), holding(2, 30, true)];
        assert_eq!(room(100, 1, &both), Room::Of(1), "above its part: its own");
        assert_eq!(room(100, 2, &both), Room::Of(1), "below its part: from who has more");
        let third = [holding(1, 50, true), holding(2, 50, true)];
        assert_eq!(room(100, 3, &third), Room::Of(2), "a third scene is let in");
    }

    #[test]
    fn resting_scene_keeps_an_eighth_and_no_more() {
        let most = [holding(1, 40, true), holding(2, 60, false)];
        assert_eq!(room(100, 1, &most), Room::Anywhere);
        let rest = [holding(1, 88, true), holding(2, 12, false)];
        assert_eq!(room(100, 1, &rest), Room::Of(1));
        let little = [holding(1, 97, true), holding(2, 3, false)];
        assert_eq!(
            room(100, 1, &little),
            Room::Of(1),
            "what it has is less: all of it stays"
        );
    }
}
