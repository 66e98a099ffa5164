//! Philox4x32-10, the counter-based generator that every random draw of the planner comes from.
//!
//! A counter-based generator has no state: the block of random bits is a function of (key,
//! counter), so a draw depends on what it is for and not on what was drawn before it, on which
//! thread, or in which order. Source: Salmon et al., "Parallel random numbers: as easy as 1, 2,
//! 3", SC 2011, section 3.2.

/// Rounds of the cipher; 10 is the authors' recommendation (7 already pass BigCrush).
const ROUNDS: usize = 10;
const MULTIPLIER_0: u64 = 0xD251_1F53;
const MULTIPLIER_1: u64 = 0xCD9E_8D57;
/// Weyl increments of the key: golden ratio and sqrt(3) - 1.
const WEYL_0: u32 = 0x9E37_79B9;
const WEYL_1: u32 = 0xBB67_AE85;

/// `W` independent blocks at once, lane `i` being the block of counter
/// `[counter[0][i], .., counter[3][i]]`: arrays of lanes, so that the compiler vectorises.
#[inline(always)]
pub fn philox_lanes<const W: usize>(
    mut counter: [[u32; W]; 4],
    mut key: [u32; 2],
) -> [[u32; W]; 4] {
    for _ in 0..ROUNDS {
        let mut next = [[0u32; W]; 4];
        for lane in 0..W {
            let product_0 = MULTIPLIER_0 * u64::from(counter[0][lane]);
            let product_1 = MULTIPLIER_1 * u64::from(counter[2][lane]);
            next[0][lane] = (product_1 >> 32) as u32 ^ counter[1][lane] ^ key[0];
            next[1][lane] = product_1 as u32;
            next[2][lane] = (product_0 >> 32) as u32 ^ counter[3][lane] ^ key[1];
            next[3][lane] = product_0 as u32;
        }
        counter = next;
        key = [key[0].wrapping_add(WEYL_0), key[1].wrapping_add(WEYL_1)];
    }
    counter
}

/// One block: 128 random bits for `counter` under `key`.
///
/// ```
/// use hvf_core::planner::philox::philox;
/// assert_eq!(philox([0; 4], [0; 2]), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
/// ```
pub fn philox(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    philox_lanes(counter.map(|word| [word]), key).map(|[word]| word)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The known answers of Random123's `kat_vectors` for `philox4x32 10`.
    const KNOWN_ANSWERS: [([u32; 4], [u32; 2], [u32; 4]); 3] = [
        ([0; 4], [0; 2], [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]),
        ([u32::MAX; 4], [u32::MAX; 2], [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]),
        (
            [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
            [0xa409_3822, 0x299f_31d0],
            [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1],
        ),
    ];

    #[test]
    fn reproduces_the_known_answers_of_random123() {
        for (counter, key, expected) in KNOWN_ANSWERS {
            assert_eq!(philox(counter, key), expected);
        }
    }

    #[test]
    fn lanes_are_independent_blocks() {
        let counter = [[1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12]];
        let lanes = philox_lanes(counter, [13, 14]);
        for lane in 0..3 {
            let block = philox(counter.map(|words| words[lane]), [13, 14]);
            assert_eq!(lanes.map(|words| words[lane]), block);
        }
    }
}
