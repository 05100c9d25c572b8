"""Which frames of a video are taken."""

from __future__ import annotations

import numpy as np

from stages.ingest import frame_selection
from stages.ingest.frame_selection import (
    BLURRED_BELOW,
    FEWEST_FRAMES,
    LEAST_STEP,
    MAX_GAP,
    STEP,
    FrameMeter,
    MeasuredFrame,
    SelectedFrame,
    select_frames,
    travelled,
)
from tests.ingest.films import at, smeared


def walk(speeds: np.ndarray, sharp: np.ndarray | None = None) -> list[MeasuredFrame]:
    """Frames of a camera that moves by `speeds` [F] in parts of the picture."""
    sharp = np.full(len(speeds), 3.0) if sharp is None else sharp
    return [
        MeasuredFrame(i / 30, float(s), np.tile(np.array([v, 0.0], np.float32), (24, 1)))
        for i, (v, s) in enumerate(zip(speeds, sharp, strict=True))
    ]


def numbers(chosen: list[SelectedFrame]) -> list[int]:
    return [one.number for one in chosen]


def test_frames_come_as_the_picture_moves_not_as_time_goes():
    speeds = np.concatenate([np.full(100, 0.02), np.full(300, 0.0), np.full(100, 0.02)])
    found = select_frames(walk(speeds), 0)
    standing = [n for n in numbers(found) if 105 <= n < 395]
    assert len(standing) <= 1
    assert len(found) == round(speeds.sum() / STEP)
    gaps = [one.moved for one in found[1:]]
    assert max(gaps) < 2 * STEP
    assert min(gaps) > 0.3 * STEP


def test_a_short_film_gives_as_many_frames_as_an_object_needs_if_they_differ():
    short = select_frames(walk(np.full(117, 0.4 / 117)), 0)
    assert FEWEST_FRAMES - 1 <= len(short) <= FEWEST_FRAMES
    assert min(one.moved for one in short[1:]) > 0.5 * LEAST_STEP
    still = select_frames(walk(np.full(117, 0.1 / 117)), 0)
    assert len(still) <= 0.1 / LEAST_STEP + 1


def test_a_hand_that_trembles_on_the_spot_gets_nowhere():
    rng = np.random.default_rng(0)
    places = 0.004 * rng.normal(size=600)
    assert travelled(walk_of(np.diff(places, prepend=0)))[-1] < 0.3
    assert np.abs(np.diff(places)).sum() > 2


def walk_of(speeds: np.ndarray) -> np.ndarray:
    return np.array([seen.motion for seen in walk(speeds)])


def test_of_frames_of_which_a_fifth_is_blurred_none_is_blurred():
    rng = np.random.default_rng(1)
    sharp = 3 + 0.1 * rng.normal(size=400)
    blurred = rng.random(400) < 0.2
    sharp[blurred] *= rng.uniform(0.3, 0.7, blurred.sum())
    found = select_frames(walk(np.full(400, 0.01), sharp), 0)
    assert not blurred[numbers(found)].any()
    assert len(found) > 70


def test_blurred_frames_are_taken_only_where_the_gap_would_be_too_wide():
    sharp = np.full(900, 3.0)
    sharp[100:110] = sharp[400:490] = 1.0
    found = select_frames(walk(np.full(900, 0.01), sharp), 0)
    short = [n for n in numbers(found) if 100 <= n < 110]
    bridges = [one for one in found if 400 <= one.number < 490]
    assert not short
    assert 1 <= len(bridges) < 8
    assert max(one.moved for one in found) <= MAX_GAP + 2 * STEP


def test_as_many_frames_as_wanted_also_if_some_are_blurred():
    sharp = np.full(300, 3.0)
    sharp[::5] = 1.0
    for wanted in (1, 7, 40, 200):
        found = select_frames(walk(np.full(300, 0.01), sharp), wanted)
        assert len(found) == wanted
        assert numbers(found) == sorted(set(numbers(found)))
        assert all(one.sharpness >= BLURRED_BELOW for one in found)


def test_any_number_of_frames_is_selected_soon(monkeypatch):
    made = []

    def counted(*given):
        made.append(given)
        return one_per_stretch(*given)

    one_per_stretch = frame_selection._one_per_stretch
    monkeypatch.setattr(frame_selection, "_one_per_stretch", counted)
    sharp = np.full(300, 3.0)
    sharp[::3] = 0.1
    found = [len(select_frames(walk(np.full(300, 0.01), sharp), n)) for n in (100, 400, 100_000)]
    assert len(made) < 400
    assert found[0] <= found[1] == found[2]


def test_more_frames_than_there_are_gives_all_that_are_sharp():
    assert numbers(select_frames(walk(np.full(10, 0.05)), 50)) == list(range(10))


def test_a_film_that_does_not_move_gives_a_few_frames():
    assert 1 <= len(select_frames(walk(np.zeros(100)), 0)) <= 3


def test_motion_is_measured_in_parts_of_the_longer_side_and_blur_is_seen():
    meter = FrameMeter()
    seen = [meter.measure(at(8 * i)[..., 1], i / 30) for i in range(6)]
    assert abs(travelled(np.array([one.motion for one in seen]))[-1] - 5 * 8 / 320) < 0.01
    blurred = FrameMeter().measure(smeared(at(0))[..., 1], 0.0)
    assert blurred.sharpness < BLURRED_BELOW * seen[0].sharpness
