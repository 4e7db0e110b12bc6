"""One clock for the topics of a log: header stamps beside log times."""

from collections.abc import Collection

import numpy as np

from .recording import Recording


def on_one_clock(recording: Recording, dt: float, shifted: Collection[str]) -> Recording:
    """The recording with its topics on the clock of the log, where their clocks differ by what is no latency.

    A stamp is behind the log time of its message by the latency of the recorder: never ahead of it, by no more than
    0.25 s, and by the same at the end as at the start, to a row each.  Within this, a difference of more than a row is
    reported, save for topics in `shifted`.
    """
    lags = {topic: np.array(track.lag, float).T for topic, track in recording.tracks.items() if track.lag}
    clocks = {track.clock for track in recording.tracks.values() if not track.lag}
    if len(clocks) > 1:
        names = " and ".join(repr(name) for name in sorted(clocks))
        return recording._replace(notes=(*recording.notes, f"times are of {names}: are these of one clock?"))
    if len(lags) < 2:
        return recording
    at = np.unique(np.concatenate([stamps for stamps, _ in lags.values()]))
    behind = {topic: -1e-9 * np.interp(at, *lag) for topic, lag in lags.items()}
    late = np.stack([*behind.values()])
    apart = late.max(0) - late.min(0)
    if apart.max() <= dt:
        return recording
    words = {
        topic: f"{topic} are {abs(np.median(each)):.3f} s {'behind' if np.median(each) > 0 else 'ahead of'}"
        for topic, each in behind.items()
        if np.abs(each).max() > dt
    }
    stamps = f"header stamps of {', those of '.join(words.values())} the clock of the log"
    latency = 0.25  # longest one of a recorder [s]: stamps that are more behind the log times are of another clock
    if late.min() < -dt or late.max() > latency or np.ptp(apart) > dt:
        tracks = dict(recording.tracks)
        for topic in words:
            t = tracks[topic].t
            tracks[topic] = tracks[topic]._replace(t=t - np.round(np.interp(t, *lags[topic])).astype(np.int64))
        note = f"{stamps}: taken out, all topics are on the clock of the log"
        return recording._replace(tracks=tracks, notes=(*recording.notes, note))
    if set(words) <= set(shifted):
        return recording
    hint = ", ".join(f"--shift {topic}={np.median(behind[topic]):.3g}" for topic in words)
    note = f"{stamps}, not those of other topics: where this is no latency, {hint} takes it out"
    return recording._replace(notes=(*recording.notes, note))
