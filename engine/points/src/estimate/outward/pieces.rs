//! Pieces of the surface whose sides agree, turned as wholes: a body that is inside out, or the hills of a terrain against its
//! valleys, which no winding number tells apart.

use super::super::neighbours::Neighbours;
use super::representatives::Representatives;
use super::winding::{HALF, Source, Tree};
use glam::Vec3;
use std::collections::BTreeMap;

/// Neighbours that a representative may share a sheet with.
const BESIDE: usize = 8;
/// Least cosine between normals on a sheet, up to the side.
const ALONG_COSINE_MIN: f32 = 0.5;
/// Most that a neighbour on a sheet may be off the plane, of its distance.
const OFF_PLANE_MAX: f32 = 0.4;

/// A piece whose winding number is this share of a half on itself is a body: it meets others but does not continue in them.
const CLOSED: f32 = 0.75;
/// A piece is turned if the winding number says so by this share of the most it can say.
const EVIDENCE: f32 = 0.1;
/// Of the neighbours of a piece that stands alone at most this share is of others.
const ALONE: f32 = 0.125;
/// Mean cosine to the direction from the middle below which a sheet has no outer side.
const AWAY: f32 = 0.2;
/// Pieces above this share of the surface count as large: what they do to the others is looked at too.
const LARGE: f32 = 0.003;
/// Most large pieces, the largest: a bound on the time of clouds without bodies.
const LARGE_MAX: usize = 32;
/// Every piece is looked at that often.
const SWEEPS: usize = 2;

/// Turns pieces until the sides agree along sheets and with the winding number; the normals then.
pub(super) fn turn(
    representatives: &Representatives,
    mut normals: Vec<Vec3>,
    tree: &Tree<'_>,
    threads: usize,
) -> Vec<Vec3> {
    let surface = Surface {
        representatives,
        tree,
        neighbours: Neighbours::new(&representatives.positions),
        threads,
    };
    let pieces = surface.join(&mut normals);
    surface.face_out(pieces, &mut normals);
    normals
}

/// Representatives whose sides agree.
struct Piece {
    members: Vec<u32>,
    area: f32,
}

struct Surface<'a> {
    representatives: &'a Representatives,
    tree: &'a Tree<'a>,
    neighbours: Neighbours<'a>,
    threads: usize,
}

impl Surface<'_> {
    /// The representatives on the same sheet as one, and the cosine of their normals.
    fn beside(&self, normals: &[Vec3], of: usize) -> impl Iterator<Item = (usize, f32)> {
        let positions = &self.representatives.positions;
        let mut found = [(0, 0.0); BESIDE];
        let mut count = 0;
        for &(squared, other) in self.neighbours.nearest::<BESIDE>(of).found() {
            let other = other as usize;
            let offset = positions[other] - positions[of];
            let off = normals[of].dot(offset).abs().max(normals[other].dot(offset).abs());
            let cosine = normals[of].dot(normals[other]);
            if off * off <= OFF_PLANE_MAX * OFF_PLANE_MAX * squared && cosine.abs() >= ALONG_COSINE_MIN {
                found[count] = (other, cosine);
                count += 1;
            }
        }
        found.into_iter().take(count)
    }

    /// The pieces that agree.
    fn agreeing(&self, normals: &[Vec3]) -> Vec<Piece> {
        let mut above: Vec<u32> = (0..normals.len() as u32).collect();
        for of in 0..normals.len() {
            for (other, cosine) in self.beside(normals, of) {
                if cosine > 0.0 {
                    let (a, b) = (first_of(&mut above, of), first_of(&mut above, other));
                    above[a.max(b)] = a.min(b) as u32;
                }
            }
        }
        let mut members = BTreeMap::<usize, Vec<u32>>::new();
        for of in 0..normals.len() {
            members.entry(first_of(&mut above, of)).or_default().push(of as u32);
        }
        members.into_values().map(|members| self.piece(members)).collect()
    }

    fn piece(&self, members: Vec<u32>) -> Piece {
        let area = members.iter().map(|&of| self.representatives.areas[of as usize]).sum();
        Piece { members, area }
    }

    /// Makes one piece of those of which one continues in the other against its side, beginning with the longest border, and
    /// turns the smaller of them. Two bodies that touch stay two.
    fn join(&self, normals: &mut [Vec3]) -> Vec<Piece> {
        let mut pieces = self.agreeing(normals);
        let own = self.own_winding(&pieces, normals);
        let mut closed: Vec<bool> = pieces.iter().map(|piece| self.is_closed(piece, &own)).collect();
        let mut part_of = parts(&pieces, normals.len());
        let mut borders = BTreeMap::<(u32, u32), f32>::new();
        for of in 0..normals.len() {
            for (other, cosine) in self.beside(normals, of) {
                let (a, b) = (part_of[of], part_of[other]);
                if a != b {
                    *borders.entry((a.min(b), a.max(b))).or_default() += cosine.abs();
                }
            }
        }
        let mut borders: Vec<((u32, u32), f32)> = borders.into_iter().collect();
        borders.sort_by(|a, b| b.1.total_cmp(&a.1));

        // Where each of the first pieces went, and whether it was turned.
        let firsts: Vec<u32> = pieces.iter().map(|piece| piece.members[0]).collect();
        let mut turned = vec![false; normals.len()];
        for ((a, b), _) in borders {
            let (a, b) = (firsts[a as usize] as usize, firsts[b as usize] as usize);
            let (mut large, mut small) = (part_of[a] as usize, part_of[b] as usize);
            if large == small || closed[large] && closed[small] {
                continue;
            }
            if pieces[large].members.len() < pieces[small].members.len() {
                (large, small) = (small, large);
            }
            let moved = std::mem::replace(&mut pieces[small], self.piece(Vec::new()));
            let against = turned[a] == turned[b];
            for &of in &moved.members {
                part_of[of as usize] = large as u32;
                turned[of as usize] ^= against;
            }
            closed[large] |= closed[small];
            pieces[large].area += moved.area;
            pieces[large].members.extend(moved.members);
        }
        for (normal, turned) in normals.iter_mut().zip(turned) {
            if turned {
                *normal = -*normal;
            }
        }
        for piece in &mut pieces {
            // Along the Z-curve again.
            piece.members.sort_unstable();
        }
        pieces.retain(|piece| !piece.members.is_empty());
        pieces
    }

    fn is_closed(&self, piece: &Piece, own: &[f32]) -> bool {
        let areas = &self.representatives.areas;
        let winding: f32 = piece
            .members
            .iter()
            .map(|&of| areas[of as usize] * own[of as usize])
            .sum();
        winding.abs() > CLOSED * HALF * piece.area
    }

    /// The winding number of every piece on itself.
    fn own_winding(&self, pieces: &[Piece], normals: &[Vec3]) -> Vec<f32> {
        let Representatives {
            positions,
            codes,
            areas,
            ..
        } = self.representatives;
        let mut own = vec![0.0; normals.len()];
        for Piece { members, .. } in pieces {
            // One alone winds around nothing.
            if members.len() < 2 {
                continue;
            }
            let of = |index: &u32| *index as usize;
            let positions: Vec<Vec3> = members.iter().map(|index| positions[of(index)]).collect();
            let codes: Vec<u64> = members.iter().map(|index| codes[of(index)]).collect();
            let areas: Vec<f32> = members.iter().map(|index| areas[of(index)]).collect();
            let sources: Vec<Source> = members
                .iter()
                .zip(&areas)
                .map(|(index, &area)| Source {
                    dipole: normals[of(index)] * area,
                    charge: 0.0,
                })
                .collect();
            let fields = Tree::new(&positions, &codes, &areas).fields(&sources, self.threads);
            for (index, field) in members.iter().zip(fields) {
                own[of(index)] = field.winding;
            }
        }
        own
    }

    /// The winding number of those whose normals are not zero, at all.
    fn winding(&self, normals: &[Vec3]) -> Vec<f32> {
        let sources: Vec<Source> = normals
            .iter()
            .zip(&self.representatives.areas)
            .map(|(&normal, &area)| Source {
                dipole: normal * area,
                charge: 0.0,
            })
            .collect();
        let fields = self.tree.fields(&sources, self.threads);
        fields.iter().map(|field| field.winding).collect()
    }

    /// The winding number of a piece: at all, if it is large, else at its own members, where it is known.
    fn reach(&self, piece: &Piece, normals: &[Vec3], own: &[f32], is_large: bool) -> Vec<(usize, f32)> {
        let members = piece.members.iter().map(|&of| of as usize);
        if !is_large {
            return members.map(|of| (of, own[of])).collect();
        }
        let mut alone = vec![Vec3::ZERO; normals.len()];
        members.for_each(|of| alone[of] = normals[of]);
        self.winding(&alone).into_iter().enumerate().collect()
    }

    /// Turns every piece that brings the winding number closer to a half so, the largest first.
    fn face_out(&self, mut pieces: Vec<Piece>, normals: &mut [Vec3]) {
        let areas = &self.representatives.areas;
        let mut own = self.own_winding(&pieces, normals);
        let mut all = self.winding(normals);
        pieces.sort_by(|a, b| b.area.total_cmp(&a.area));
        let part_of = parts(&pieces, normals.len());
        let large = LARGE * pieces.iter().map(|piece| piece.area).sum::<f32>();
        for _ in 0..SWEEPS {
            for (number, piece) in pieces.iter().enumerate() {
                let is_large = number < LARGE_MAX && piece.area > large;
                let reach = self.reach(piece, normals, &own, is_large);
                // What turning it adds to the squares of the errors, over four.
                let worse: f32 = reach
                    .iter()
                    .map(|&(at, winding)| areas[at] * winding * (HALF - all[at] + winding))
                    .sum();
                let faces_out = if worse.abs() > EVIDENCE * HALF * HALF * piece.area {
                    worse > 0.0
                } else {
                    !self.is_alone(piece, &part_of) || self.faces_away(piece, normals)
                };
                if faces_out {
                    continue;
                }
                reach.iter().for_each(|&(at, winding)| all[at] -= 2.0 * winding);
                for &of in &piece.members {
                    let of = of as usize;
                    normals[of] = -normals[of];
                    own[of] = -own[of];
                }
            }
        }
    }

    /// Whether few neighbours of a piece are of others.
    fn is_alone(&self, piece: &Piece, part_of: &[u32]) -> bool {
        let (mut count, mut others) = (0, 0);
        for &of in &piece.members {
            for &(_, other) in self.neighbours.nearest::<BESIDE>(of as usize).found() {
                count += 1;
                others += u32::from(part_of[other as usize] != part_of[of as usize]);
            }
        }
        others as f32 <= ALONE * count as f32
    }

    /// Where the winding number has no say: whether a piece faces away from the middle, or, if it does neither so nor the
    /// opposite, along the axis that it faces most; a terrain does up.
    fn faces_away(&self, piece: &Piece, normals: &[Vec3]) -> bool {
        let Representatives { positions, areas, .. } = self.representatives;
        let (mut away, mut sum) = (0.0, Vec3::ZERO);
        for &of in &piece.members {
            let normal = normals[of as usize] * areas[of as usize];
            away += normal.dot(positions[of as usize].normalize_or_zero());
            sum += normal;
        }
        if away.abs() > AWAY * piece.area {
            return away > 0.0;
        }
        let most = sum.to_array().into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs()));
        most.is_none_or(|most| most >= 0.0)
    }
}

/// The piece of every representative.
fn parts(pieces: &[Piece], count: usize) -> Vec<u32> {
    let mut part_of = vec![0; count];
    for (number, piece) in pieces.iter().enumerate() {
        for &of in &piece.members {
            part_of[of as usize] = number as u32;
        }
    }
    part_of
}

/// The first member of the set that a representative is in; shortens the way there.
fn first_of(above: &mut [u32], of: usize) -> usize {
    let mut at = of;
    while above[at] as usize != at {
        above[at] = above[above[at] as usize];
        at = above[at] as usize;
    }
    at
}
