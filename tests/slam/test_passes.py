"""Passes of global adjustment."""

from __future__ import annotations

import pytest

from droidw.config.schema import BackendConfig
from droidw.slam.passes import all_passes, last_passes


def options(*updates, **more):
    return BackendConfig(passes=list(updates), **more)


def kernels(passes):
    return [part.kernel for part in passes]


@pytest.mark.parametrize(
    ("count", "wide", "expected"),
    [
        (0, True, ""),
        (1, True, "narrow"),
        (2, True, "wide narrow"),
        (3, True, "wide usual narrow"),
        (5, True, "wide usual narrow narrowest narrowest"),
        (1, False, "narrow"),
        (2, False, "usual narrow"),
        (4, False, "usual narrow narrowest narrowest"),
    ],
)
def test_kernels_narrow_from_one_to_the_next(count, wide, expected):
    assert kernels(all_passes(options(*range(1, count + 1)), wide)) == expected.split()


def test_no_pass_is_wide_with_a_start_as_wide_as_the_kernel():
    assert kernels(all_passes(options(1, 1, wide_start=1.0), wide=True)) == ["usual", "narrow"]


def test_measurements_have_the_last_word():
    assert [part.steady for part in all_passes(options(1, 1, 1), wide=True)] == [1.0, 1 / 3, 0.0]
    assert not any(part.steady for part in last_passes(options(1, 1, 1), wide=True))


@pytest.mark.parametrize(("wide", "expected"), [(True, [0, 1, 0]), (False, [1, 0, 0])])
def test_the_focal_length_waits_for_a_path_that_is_mended(wide, expected):
    assert [part.refines for part in all_passes(options(1, 1, 1), wide)] == expected
    assert not any(part.refines for part in last_passes(options(1, 1, 1), wide=True))


@pytest.mark.parametrize(
    ("updates", "wide", "expected"),
    [
        ([], True, []),
        ([4], True, [(4, "narrow")]),
        ([3, 4], True, [(3, "usual"), (4, "narrow")]),
        ([2, 3, 4], True, [(3, "usual"), (4, "narrow")]),
        ([2, 3, 4], False, [(2, "usual"), (3, "narrow"), (4, "narrowest")]),
        ([1, 2, 3, 4, 5], True, [(3, "usual"), (4, "narrow"), (5, "narrowest")]),
    ],
)
def test_the_last_passes_end_as_all_of_them_do(updates, wide, expected):
    given = options(*updates)
    found = last_passes(given, wide)
    assert [(part.updates, part.kernel) for part in found] == expected
    assert kernels(found)[-1:] == kernels(all_passes(given, wide))[-1:]
