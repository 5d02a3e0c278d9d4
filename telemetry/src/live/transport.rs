//! The position on a timeline that a viewer plays, pauses and seeks. It reads no clock.

use std::time::Duration;

use foxglove::websocket::{PlaybackCommand, PlaybackControlRequest, PlaybackState, PlaybackStatus};

/// Slowest and fastest speed, as factors of real time.
const SPEEDS: (f32, f32) = (0.01, 100.0);

/// The position on a timeline from 0 to its end.
#[derive(Debug, Clone)]
pub(super) struct Transport {
    end_ns: u64,
    is_playing: bool,
    speed: f32,
    /// The position when the clock showed `since`.
    position_ns: u64,
    since: Duration,
}

impl Transport {
    /// Creates a transport that plays from the start, from the time `now` on.
    pub(super) const fn playing(end_ns: u64, now: Duration) -> Self {
        Self { end_ns, is_playing: true, speed: 1.0, position_ns: 0, since: now }
    }

    /// Returns the position at the time `now`.
    pub(super) fn position_ns(&self, now: Duration) -> u64 {
        if !self.is_playing {
            return self.position_ns;
        }
        let played = now.saturating_sub(self.since).mul_f32(self.speed);
        let played_ns = u64::try_from(played.as_nanos()).unwrap_or(u64::MAX);
        self.position_ns.saturating_add(played_ns).min(self.end_ns)
    }

    /// Returns true if the position moves.
    pub(super) const fn is_playing(&self) -> bool {
        self.is_playing
    }

    /// Returns true if the end is reached at the time `now`.
    pub(super) fn has_ended(&self, now: Duration) -> bool {
        self.position_ns(now) == self.end_ns
    }

    /// Executes a viewer's request and returns the state that answers it. Playing at the end starts again.
    pub(super) fn handle(
        &mut self,
        request: &PlaybackControlRequest,
        now: Duration,
    ) -> PlaybackState {
        self.position_ns = self.position_ns(now);
        self.since = now;
        if request.playback_speed.is_finite() && request.playback_speed > 0.0 {
            self.speed = request.playback_speed.clamp(SPEEDS.0, SPEEDS.1);
        }
        let is_play = request.playback_command == PlaybackCommand::Play;
        let restarts = is_play && !self.is_playing && self.position_ns == self.end_ns;
        let sought_ns = request.seek_time.or(restarts.then_some(0));
        if let Some(sought_ns) = sought_ns {
            self.position_ns = sought_ns.min(self.end_ns);
        }
        self.is_playing = is_play;
        PlaybackState { did_seek: sought_ns.is_some(), ..self.state(now) }
    }

    /// Stops at the end.
    pub(super) fn end(&mut self) {
        self.position_ns = self.end_ns;
        self.is_playing = false;
    }

    /// Returns the state at the time `now`.
    pub(super) fn state(&self, now: Duration) -> PlaybackState {
        let status = match (self.is_playing, self.has_ended(now)) {
            (_, true) => PlaybackStatus::Ended,
            (true, _) => PlaybackStatus::Playing,
            (false, _) => PlaybackStatus::Paused,
        };
        PlaybackState {
            status,
            current_time: self.position_ns(now),
            playback_speed: self.speed,
            did_seek: false,
            request_id: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Duration = Duration::from_secs(1);

    fn request(
        command: PlaybackCommand,
        speed: f32,
        seek_ns: Option<u64>,
    ) -> PlaybackControlRequest {
        PlaybackControlRequest {
            playback_command: command,
            playback_speed: speed,
            seek_time: seek_ns,
            request_id: "1".to_owned(),
        }
    }

    #[test]
    fn a_position_follows_clock_speed_pause_and_seek() {
        let mut transport = Transport::playing(10_000_000_000, S);
        assert_eq!(transport.position_ns(3 * S), 2_000_000_000);
        let faster = transport.handle(&request(PlaybackCommand::Play, 2.0, None), 3 * S);
        assert_eq!((faster.current_time, faster.did_seek), (2_000_000_000, false));
        assert_eq!(transport.position_ns(4 * S), 4_000_000_000);
        let paused = transport.handle(&request(PlaybackCommand::Pause, 2.0, Some(7)), 4 * S);
        assert_eq!((paused.status, paused.did_seek), (PlaybackStatus::Paused, true));
        assert_eq!(transport.position_ns(100 * S), 7);
    }

    #[test]
    fn playing_at_the_end_starts_again() {
        let mut transport = Transport::playing(10, S);
        assert!(transport.has_ended(2 * S));
        transport.end();
        assert_eq!(transport.state(2 * S).status, PlaybackStatus::Ended);
        let again = transport.handle(&request(PlaybackCommand::Play, 1.0, None), 2 * S);
        assert_eq!((again.status, again.current_time), (PlaybackStatus::Playing, 0));
        let beyond = transport.handle(&request(PlaybackCommand::Pause, 1.0, Some(99)), 2 * S);
        assert_eq!(beyond.current_time, 10, "no position beyond the end");
    }

    #[test]
    fn an_impossible_speed_is_ignored() {
        let mut transport = Transport::playing(10, S);
        for speed in [f32::NAN, f32::INFINITY, 0.0, -1.0] {
            let state = transport.handle(&request(PlaybackCommand::Play, speed, None), S);
            assert!((state.playback_speed - 1.0).abs() < f32::EPSILON, "{speed}");
        }
    }
}
