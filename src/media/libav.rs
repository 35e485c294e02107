//! What every use of libav here needs: its start, and its units of time.

use std::sync::Once;

use ffmpeg_next::Rational;

use crate::time::Timestamp;

/// Prepare libav, once; its own messages are silenced, since every error is reported here.
pub(crate) fn prepare_libav() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        if ffmpeg_next::init().is_err() {
            tracing::warn!("libav could not be initialised");
        }
        ffmpeg_next::log::set_level(ffmpeg_next::log::Level::Quiet);
    });
}

/// Time stamp of `ticks` units, exact to the nanosecond.
pub(crate) fn timestamp_from_ticks(ticks: i64, unit: Rational) -> Timestamp {
    let (numerator, denominator) = (i128::from(unit.numerator()), i128::from(unit.denominator().max(1)));
    let doubled = 2 * i128::from(ticks) * numerator * 1_000_000_000;
    Timestamp((doubled + denominator).div_euclid(2 * denominator) as i64)
}

/// Nearest number of units to a time stamp.
pub(crate) fn ticks_from_timestamp(time: Timestamp, unit: Rational) -> i64 {
    let divisor = i128::from(unit.numerator().max(1)) * 1_000_000_000;
    let doubled = 2 * i128::from(time.0) * i128::from(unit.denominator());
    (doubled + divisor).div_euclid(2 * divisor) as i64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_and_time_stamps_are_inverse() {
        for unit in [
            Rational(1, 90_000),
            Rational(1, 12_800),
            Rational(1001, 30_000),
            Rational(1, 1000),
            Rational(1, 25),
        ] {
            for ticks in [-7, 0, 1, 2, 3, 1001, 33_333, 123_456_789] {
                assert_eq!(ticks_from_timestamp(timestamp_from_ticks(ticks, unit), unit), ticks, "{unit}");
            }
        }
    }

    #[test]
    fn one_tick_is_rounded_to_the_nearest_nanosecond() {
        assert_eq!(timestamp_from_ticks(1, Rational(1, 90_000)), Timestamp(11_111));
        assert_eq!(timestamp_from_ticks(2, Rational(1, 90_000)), Timestamp(22_222));
        assert_eq!(timestamp_from_ticks(-1, Rational(1, 3)), Timestamp(-333_333_333));
    }
}
