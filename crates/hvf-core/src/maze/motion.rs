//! Motion of the agent along one axis between contacts, in closed form.
//!
//! A mass under a constant force with linear damping, `m v' = F - c v`. The original simulator
//! (MuJoCo) integrates this with substeps of 2 ms: velocity first (damping implicit), then
//! position with the new velocity. After `n` substeps of `h` its position is exactly
//!
//! ```text
//! x(t) = x0 + (F/c) t + (v0 - F/c) tau (1 - exp(-rate t)),   t = n h
//! tau = m/c,   rate = ln(1 + h/tau) / h
//! ```
//!
//! which is the solution of the differential equation with `rate` in place of `1/tau` in the
//! exponent (0.4% further in 0.5 s). Taken at any real `t`, it is what this module computes.

/// Mass of the agent, kg.
pub const MASS: f64 = 0.125;
/// Linear damping, N s/m.
pub const DAMPING: f64 = 0.01;
/// Integration substep of the original simulator, s.
pub const SUBSTEP: f64 = 0.002;

/// `m / c`, s.
const TAU: f64 = MASS / DAMPING;
/// `ln(1 + SUBSTEP / TAU) / SUBSTEP`, 1/s.
const RATE: f64 = 0.07999360068258475;

/// Motion along an axis that points where the agent is going, so that distances and speeds are
/// never negative. Times are at most a few seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Speed at time 0, m/s, at least 0.
    pub speed: f64,
    /// Force along the axis, N; negative if it brakes.
    pub force: f64,
}

impl Motion {
    /// Distance travelled after `time` seconds, m.
    #[inline]
    pub const fn distance(&self, time: f64) -> f64 {
        let terminal = self.force * (1.0 / DAMPING);
        terminal * time + (self.speed - terminal) * TAU * decayed(time)
    }

    /// Speed after `time` seconds, m/s.
    #[inline]
    pub fn speed_at(&self, time: f64) -> f64 {
        let terminal = self.force * (1.0 / DAMPING);
        self.speed + (terminal - self.speed) * decayed(time)
    }

    /// Distance, and its change with time in m/s, after `time` seconds. The latter is the speed
    /// to within `SUBSTEP / 2` of acceleration.
    #[inline]
    fn distance_and_slope(&self, time: f64) -> (f64, f64) {
        let terminal = self.force * (1.0 / DAMPING);
        let lag = (self.speed - terminal) * TAU;
        let decayed = decayed(time);
        (terminal * time + lag * decayed, terminal + lag * RATE * (1.0 - decayed))
    }

    /// When a motion whose `distance` may also fall, and whose speed and force have any sign, is
    /// first below `-height` from time `from` on, s; `None` if not until `latest`.
    ///
    /// Acceleration keeps its sign, so distance rises or falls, turns once at most, and is solved
    /// for where it is monotone.
    pub(super) fn falls_below(&self, height: f64, from: f64, latest: f64) -> Option<f64> {
        let above = |time: f64| height + self.distance(time);
        if above(from) < 0.0 {
            return Some(from);
        }
        let falling = self.distance_and_slope(from).1 < 0.0;
        let turn = || self.turn_time().map_or(latest, |turn| turn.clamp(from, latest));
        let bends_up = self.force >= DAMPING * self.speed;
        let (begin, end) = match (bends_up, falling) {
            (true, false) => return None,
            (true, true) => (from, turn()),
            (false, true) => (from, latest),
            (false, false) => (turn(), latest),
        };
        (above(end) < 0.0).then(|| self.crossing(height, begin, end))
    }

    /// When distance is `-height`, s, which it falls below between two times.
    fn crossing(&self, height: f64, mut begin: f64, mut end: f64) -> f64 {
        // Nearly a parabola; solve that, then polish with Newton's method.
        let (reached, slope) = self.distance_and_slope(begin);
        let half_bend = (self.force - DAMPING * self.speed) * (0.5 / MASS);
        let above = height + reached;
        let root = (slope * slope - 4.0 * half_bend * above).max(0.0).sqrt();
        let mut time = begin + 2.0 * above / (root - slope).max(f64::MIN_POSITIVE);
        if !(time >= begin && time <= end) {
            time = 0.5 * (begin + end);
        }
        for _ in 0..60 {
            let (reached, slope) = self.distance_and_slope(time);
            let error = height + reached;
            if error < 0.0 {
                end = time;
            } else {
                begin = time;
            }
            let newton = time - error / slope;
            let next = if newton >= begin && newton <= end { newton } else { 0.5 * (begin + end) };
            // Each step squares the relative error.
            if (next - time).abs() <= 1e-9 * time {
                return next;
            }
            time = next;
        }
        time
    }

    /// When a motion turns round, s; `None` if it never does. May be negative: it has turned.
    pub(super) fn turn_time(&self) -> Option<f64> {
        // slope(t) = 0, solved for t.
        let terminal = self.force * (1.0 / DAMPING);
        let ratio = (terminal - self.speed) * TAU * RATE / terminal;
        (ratio > 0.0).then(|| libm::log(ratio) / RATE)
    }

    /// When a braking force brings the agent to rest, s; `None` if the force does not brake.
    pub fn stop_time(&self) -> Option<f64> {
        if self.force >= 0.0 {
            return None;
        }
        // slope(t) = 0, solved for t.
        let terminal = self.force * (1.0 / DAMPING);
        let ratio = (terminal - self.speed) * TAU * RATE / terminal;
        Some((ratio.ln() / RATE).max(0.0))
    }

    /// When the agent has travelled `distance` metres, s, known to be within `[0, latest]`
    /// during which the agent does not stop.
    pub fn time_of(&self, distance: f64, latest: f64) -> f64 {
        if distance <= 0.0 {
            return 0.0;
        }
        // Motion is nearly a parabola; solve that, then polish with Newton's method.
        let (_, slope) = self.distance_and_slope(0.0);
        let half_bend = (self.force - DAMPING * self.speed) * (0.5 / MASS);
        let root = (slope * slope + 4.0 * half_bend * distance).max(0.0).sqrt();
        let mut time = (2.0 * distance / (slope + root)).min(latest);
        let (mut low, mut high) = (0.0, latest);
        for _ in 0..50 {
            let (reached, slope) = self.distance_and_slope(time);
            let error = reached - distance;
            if error > 0.0 {
                high = time;
            } else {
                low = time;
            }
            let newton = time - error / slope;
            let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            // Each step squares the relative error.
            if (next - time).abs() <= 1e-8 * time {
                return next;
            }
            time = next;
        }
        time
    }
}

/// `1 - exp(-RATE time)` as a series: no cancellation, and the same bits on every machine.
#[inline]
const fn decayed(time: f64) -> f64 {
    const FACTORIAL: [f64; 8] = [1.0, 2.0, 6.0, 24.0, 120.0, 720.0, 5040.0, 40320.0];
    let u = -RATE * time;
    let mut sum = 0.0;
    let mut order = FACTORIAL.len();
    while order > 0 {
        order -= 1;
        sum = sum * u + 1.0 / FACTORIAL[order];
    }
    -u * sum
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn rate_is_what_its_formula_gives() {
        assert!((RATE - (SUBSTEP / TAU).ln_1p() / SUBSTEP).abs() < 1e-15);
    }

    #[test]
    fn free_motion_for_one_unit_of_action_is_what_the_original_gives() {
        let motion = Motion { speed: 0.0, force: 0.05 };
        assert!((motion.distance(0.5) - 0.0495).abs() < 5e-5);
    }

    proptest! {
        #[test]
        fn closed_form_is_the_semi_implicit_euler_recurrence(
            speed in 0.0..1.0f64, force in -0.15..0.15f64
        ) {
            let motion = Motion { speed, force };
            let (mut x, mut v) = (0.0, speed);
            for substep in 1..=250 {
                v = (v + SUBSTEP * force / MASS) / (1.0 + SUBSTEP * DAMPING / MASS);
                x += SUBSTEP * v;
                let time = f64::from(substep) * SUBSTEP;
                prop_assert!((motion.distance(time) - x).abs() < 1e-12);
                prop_assert!((motion.speed_at(time) - v).abs() < 1e-12);
            }
        }

        #[test]
        fn time_of_a_distance_inverts_the_distance(
            speed in 0.0..1.0f64, force in -0.15..0.15f64, fraction in 0.0..1.0f64
        ) {
            let motion = Motion { speed, force };
            let latest = motion.stop_time().unwrap_or(0.5).min(0.5);
            let distance = motion.distance(latest * fraction);
            let time = motion.time_of(distance, latest);
            prop_assert!((0.0..=latest).contains(&time));
            prop_assert!((motion.distance(time) - distance).abs() < 1e-13);
        }

        #[test]
        fn a_motion_falls_below_a_height_where_a_fine_scan_first_sees_it(
            speed in -0.6..0.6f64, force in -0.15..0.15f64, height in 0.0..0.05f64,
            from in 0.0..0.2f64
        ) {
            let motion = Motion { speed, force };
            let above = |time: f64| height + motion.distance(time);
            let times = (0..=5000).map(|i| from + (0.5 - from) * f64::from(i) / 5000.0);
            let scanned = times.clone().find(|&time| above(time) < 0.0);
            match (motion.falls_below(height, from, 0.5), scanned) {
                (Some(time), Some(scanned)) => {
                    prop_assert!(time <= scanned + 1e-12 && time > scanned - 1.01e-4);
                    prop_assert!(time == from || above(time).abs() < 1e-12);
                }
                // A dip between two looks.
                (Some(time), None) => prop_assert!(above(time).abs() < 1e-9),
                (None, scanned) => prop_assert!(scanned.is_none(), "{scanned:?}"),
            }
        }

        #[test]
        fn nothing_moves_on_before_it_stops_or_back_until_then(
            speed in 0.0..1.0f64, force in -0.15..-1e-3f64
        ) {
            let motion = Motion { speed, force };
            let stop = motion.stop_time().unwrap();
            // The series holds for the times of a step.
            prop_assume!(stop <= 0.5);
            prop_assert!(stop == 0.0 || motion.distance_and_slope(stop).1.abs() < 1e-9);
            prop_assert!(stop == 0.0 || motion.distance(stop) > 0.0);
        }
    }
}
