//! Where the records of a mounted scene lie, and which receivers touched which of its pages.
//!
//! Indices come from files: what is beyond a scene's counts has no place, so that a forged scene ends in an error and nowhere
//! else.

use pbgi_core::{MountId, PageKey, PageKind, PageNo, SceneInfo};

/// What a worker knows of one mounted scene.
#[derive(Debug)]
pub struct SceneView {
    mount: MountId,
    nodes: FileView,
    points: FileView,
    /// Number of the pack of receivers that is being shaded, where stamps have it.
    pack: u32,
}

/// One of the scene's files.
#[derive(Debug)]
struct FileView {
    records: u64,
    records_per_page: u32,
    /// 2^64 over the records of a page, rounded up: every look waits for the number of its page, and a product comes sooner
    /// than a quotient.
    pages_per_record: u64,
    page_bytes: u64,
    /// By page, who touched it last: the pack, and its receivers in the low bits.
    stamps: Vec<u32>,
}

/// Where a record lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) key: PageKey,
    /// Number of the record in its page.
    pub(crate) slot: u32,
}

/// Packs are counted above the bits of a stamp that name receivers.
const PACK_STEP: u32 = 1 << u8::BITS;

impl SceneView {
    /// Prepares for a scene.
    pub fn new(scene: &SceneInfo, mount: MountId) -> Self {
        let file = |kind, records, records_per_page: u32| FileView {
            records,
            records_per_page,
            pages_per_record: u64::MAX / u64::from(records_per_page) + 1,
            page_bytes: scene.page_bytes(kind) as u64,
            stamps: vec![0; scene.page_count(kind) as usize],
        };
        Self {
            mount,
            nodes: file(PageKind::Node, scene.node_slots, scene.settings.nodes_per_page),
            points: file(PageKind::Point, scene.point_count, scene.settings.points_per_page),
            pack: 0,
        }
    }

    /// Another pack of receivers begins: nobody has touched anything.
    pub(crate) fn begin_pack(&mut self) {
        match self.pack.checked_add(PACK_STEP) {
            Some(next) => self.pack = next,
            None => {
                self.nodes.stamps.fill(0);
                self.points.stamps.fill(0);
                self.pack = PACK_STEP;
            }
        }
    }

    /// Records of a kind in the scene.
    pub(crate) fn records(&self, kind: PageKind) -> u64 {
        self.file(kind).records
    }

    /// Where a record lies, if the scene has it.
    #[inline(always)]
    pub(crate) fn place(&self, kind: PageKind, index: u32) -> Option<Place> {
        let file = self.file(kind);
        let page = file.page(index);
        let place = Place {
            key: PageKey {
                mount: self.mount,
                kind,
                page: PageNo(page),
            },
            slot: index - page * file.records_per_page,
        };
        (u64::from(index) < file.records).then_some(place)
    }

    /// Records from one on, itself included, that its page holds.
    #[inline]
    pub(crate) fn left(&self, kind: PageKind, index: u32, slot: u32) -> u32 {
        let file = self.file(kind);
        let in_file = file.records - u64::from(index);
        in_file.min(u64::from(file.records_per_page - slot)) as u32
    }

    /// Whether all these receivers of the pack have touched a page.
    #[inline(always)]
    pub(crate) fn is_touched(&self, key: PageKey, receivers: u8) -> bool {
        let stamp = self.file(key.kind).stamps.get(key.page.0 as usize);
        // Equal packs cancel out, and leave the receivers.
        let seen = stamp.map_or(u32::MAX, |stamp| stamp ^ self.pack);
        seen < PACK_STEP && u32::from(receivers) & !seen == 0
    }

    /// Notes that receivers of the pack touch a page; gives its bytes, once for each that does for the first time.
    pub(crate) fn touch(&mut self, key: PageKey, receivers: u8) -> u64 {
        let pack = self.pack;
        let file = match key.kind {
            PageKind::Node => &mut self.nodes,
            PageKind::Point => &mut self.points,
        };
        let stamp = &mut file.stamps[key.page.0 as usize];
        let seen = *stamp ^ pack;
        let before = if seen < PACK_STEP { seen as u8 } else { 0 };
        *stamp = pack | u32::from(before | receivers);
        u64::from((receivers & !before).count_ones()) * file.page_bytes
    }

    #[inline(always)]
    fn file(&self, kind: PageKind) -> &FileView {
        match kind {
            PageKind::Node => &self.nodes,
            PageKind::Point => &self.points,
        }
    }
}

impl FileView {
    /// The page of a record, for any index.
    #[inline(always)]
    fn page(&self, index: u32) -> u32 {
        ((u128::from(self.pages_per_record) * u128::from(index)) >> u64::BITS) as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pbgi_core::limits::RECORDS_PER_PAGE_RANGE;
    use pbgi_core::{BuildId, BuildSettings, NodeIndex};

    fn view(node_slots: u64, nodes_per_page: u32) -> SceneView {
        let scene = SceneInfo {
            build_id: BuildId(1),
            point_count: 0,
            node_count: node_slots,
            node_slots,
            root: Some(NodeIndex(0)),
            bounds: None,
            quantizer: None,
            radius_max: 1.0,
            origin: [0.0; 3],
            settings: BuildSettings {
                nodes_per_page,
                ..BuildSettings::default()
            },
        };
        SceneView::new(&scene, MountId { slot: 1, generation: 2 })
    }

    #[test]
    fn place_is_quotient_and_remainder_up_to_the_last_record() {
        let (least, most) = RECORDS_PER_PAGE_RANGE.into_inner();
        for per_page in [least, 17, 60, 255, 256, 257, 1000, most - 1, most] {
            let view = view(1 << 32, per_page);
            let last = u32::MAX / per_page * per_page;
            for index in [0, 1, per_page - 1, per_page, per_page + 1, last - 1, last, u32::MAX] {
                let place = view.place(PageKind::Node, index).unwrap();
                assert_eq!(
                    (place.key.page.0, place.slot),
                    (index / per_page, index % per_page),
                    "{index} by {per_page}"
                );
            }
        }
        assert_eq!(view(65, 16).place(PageKind::Node, 65), None);
    }

    #[test]
    fn receivers_touch_a_page_once_a_pack() {
        let mut view = view(64, 16);
        view.begin_pack();
        let place = view.place(PageKind::Node, 20).unwrap();
        let page_bytes = view.nodes.page_bytes;
        assert!(!view.is_touched(place.key, 1));
        assert_eq!(view.touch(place.key, 0b0011), 2 * page_bytes);
        assert_eq!(view.touch(place.key, 0b0110), page_bytes);
        assert!(view.is_touched(place.key, 0b0101) && !view.is_touched(place.key, 0b1001));
        view.begin_pack();
        assert!(!view.is_touched(place.key, 1));
        // When all numbers are used up, the stamps start anew.
        view.pack = u32::MAX - (PACK_STEP - 1);
        assert_eq!(view.touch(place.key, 1), page_bytes);
        view.begin_pack();
        assert!(!view.is_touched(place.key, 1));
    }
}
