"""The way in for people's own loaders: arrays, functions and iterators."""

import numpy as np
import pytest

from giorom.data.readers import DataError, from_arrays

MOTION = np.random.default_rng(0).random((5, 7, 2))


@pytest.mark.parametrize(
    "frames",
    [MOTION, list(MOTION), lambda: iter(MOTION), lambda: MOTION, MOTION.tolist()],
    ids=["array", "list", "generator function", "array function", "nested lists"],
)
def test_what_can_be_started_again_is_read_twice(frames):
    """Both readings are the arrays that were given."""
    motion = from_arrays(frames, frame_dt=0.1, bounds=[[0, 1], [0, 2]], particle_type=[3] * 7)
    for _ in range(2):
        np.testing.assert_array_equal(list(motion.frames()), MOTION)
    assert motion.frame_dt == 0.1
    np.testing.assert_array_equal(motion.bounds, [[0, 1], [0, 2]])
    assert motion.particle_type.tolist() == [3] * 7


def test_an_iterator_is_read_once_and_says_so():
    """All frames come, the first too; the second reading is an error."""
    motion = from_arrays(iter(MOTION), name="mine")
    np.testing.assert_array_equal(list(motion.frames()), MOTION)
    assert motion.particle_type.tolist() == [5] * 7
    with pytest.raises(DataError, match="mine was given as an iterator"):
        list(motion.frames())


def test_frames_are_asked_for_one_at_a_time():
    """After reading two frames the generator has made two and no more."""
    made = []

    def frames():
        for index, frame in enumerate(MOTION):
            made.append(index)
            yield frame

    reading = from_arrays(frames()).frames()
    assert made == [0]
    next(reading), next(reading)
    assert made == [0, 1]


def test_an_error_of_the_callers_loader_passes_through():
    """It is their program's, not the data's."""

    def frames():
        yield MOTION[0]
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        list(from_arrays(frames).frames())


WRONG = {
    "nothing": ({"frames": []}, "no frames"),
    "one axis": ({"frames": [np.zeros(3)]}, "shape \\(3,\\)"),
    "four axes": ({"frames": [np.zeros((3, 4))]}, "2 or 3"),
    "no particles": ({"frames": [np.zeros((0, 2))]}, "no particles"),
    "words": ({"frames": [[["a", "b"]]]}, "must be numbers"),
    "ragged": ({"frames": [[[1, 2], [3]]]}, "no array"),
    "types": ({"frames": MOTION, "particle_type": [5]}, "each of the 7"),
    "no type": ({"frames": MOTION, "particle_type": [9] * 7}, "between 0"),
    "float types": ({"frames": MOTION, "particle_type": [5.0] * 7}, "whole"),
    "bounds": ({"frames": MOTION, "bounds": [0, 1]}, "lower, upper"),
    "time": ({"frames": MOTION, "frame_dt": 0.0}, "frame_dt"),
    "count": ({"frames": [MOTION[0], MOTION[0][:3]]}, "frame 1 has shape \\(3, 2\\)"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_a_motion_is_refused(case):
    """Each is wrong in one way; the message names it."""
    options, word = WRONG[case]
    with pytest.raises(DataError, match=word):
        list(from_arrays(**options).frames())
