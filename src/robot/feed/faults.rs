//! A bad line, on purpose: bytes corrupted, lost and inserted at random.

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Shares of bytes, 0–1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Damage {
    /// Replaced by another value.
    pub corrupt: f64,
    /// Lost.
    pub drop: f64,
    /// Followed by one that was not sent.
    pub insert: f64,
}

/// Does damage; the same seed does the same.
#[derive(Clone, Debug)]
pub struct BadLine {
    damage: Damage,
    random: ChaCha8Rng,
}

impl BadLine {
    /// A line that does so much damage.
    pub fn new(damage: Damage, seed: u64) -> Self {
        Self {
            damage,
            random: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// What comes out for what goes in.
    pub fn pass(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = Vec::with_capacity(bytes.len() + 4);
        for byte in bytes {
            let draw: f64 = self.random.random();
            let Damage { corrupt, drop, insert } = self.damage;
            if draw < corrupt {
                out.push(byte ^ self.random.random_range(1..=255_u8));
            } else if draw < corrupt + drop {
                continue;
            } else {
                out.push(*byte);
                if draw < corrupt + drop + insert {
                    out.push(self.random.random());
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_kept_and_seeds_repeat() {
        let damage = Damage {
            corrupt: 0.01,
            drop: 0.02,
            insert: 0.005,
        };
        let sent = vec![0xA5; 200_000];
        let came = BadLine::new(damage, 3).pass(&sent);
        assert_eq!(came, BadLine::new(damage, 3).pass(&sent));
        // Lengths: 200 000·(0.005 − 0.02) ± 5·√(200 000·0.025); corrupted: 2000 ± 5·√2000, and 1000 inserted ± 5·√1000.
        let shorter = sent.len() as f64 - came.len() as f64;
        assert!((shorter - 3000.0).abs() < 5.0 * 71.0, "{shorter}");
        let other = came.iter().filter(|byte| **byte != 0xA5).count() as f64;
        assert!((other - 3000.0).abs() < 5.0 * 55.0 + 10.0, "{other}");
        assert_eq!(BadLine::new(Damage::default(), 3).pass(b"as it was"), b"as it was");
    }
}
