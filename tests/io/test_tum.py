"""TUM trajectories: round trip, what evo makes of them, and refusals with line numbers."""

from __future__ import annotations

import os

import numpy as np
import pytest

from droidw.errors import InputError, UsageError
from droidw.io.tum import read_tum, write_tum
from droidw.slam.frame import Trajectory


def made_up(n=20, start=1341846434.710184):
    rng = np.random.default_rng(3)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    times = start + np.cumsum(rng.uniform(0.01, 0.05, n))
    return Trajectory(times, np.hstack([rng.normal(size=(n, 3)) * 10, q]))


def test_round_trip_keeps_times_exactly_and_poses_to_nine_digits(tmp_path):
    trajectory = made_up()
    write_tum(tmp_path / "a.tum", trajectory)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.times, trajectory.times)
    np.testing.assert_allclose(back.T_wc, trajectory.T_wc, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(back.T_wc[:, 3:], axis=1), 1.0, rtol=1e-12)


def test_map_coordinates_keep_their_digits_if_asked(tmp_path):
    trajectory = made_up()
    trajectory.T_wc[:, :3] += [4.5e5, 5.5e6, 300.0]
    write_tum(tmp_path / "a.tum", trajectory, digits=15)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(back.T_wc[:, :3], trajectory.T_wc[:, :3], rtol=0, atol=1e-8)


def test_the_file_has_eight_columns_and_the_same_bytes_every_time(tmp_path):
    write_tum(tmp_path / "a.tum", made_up(), header=False)
    write_tum(tmp_path / "b.tum", made_up(), header=False)
    data = (tmp_path / "a.tum").read_bytes()
    assert data == (tmp_path / "b.tum").read_bytes()
    assert data.endswith(b"\n")
    for line in data.decode().splitlines():
        assert len(line.split(" ")) == 8
        assert line == line.strip()
    assert sorted(os.listdir(tmp_path)) == ["a.tum", "b.tum"]


def test_evo_reads_it(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo is a test extra")
    trajectory = made_up()
    write_tum(tmp_path / "a.tum", trajectory)
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    np.testing.assert_array_equal(theirs.timestamps, trajectory.times)
    np.testing.assert_allclose(theirs.positions_xyz, trajectory.T_wc[:, :3], rtol=1e-8)
    np.testing.assert_allclose(
        theirs.orientations_quat_wxyz, trajectory.T_wc[:, [6, 3, 4, 5]], atol=1e-8
    )


def test_minus_zero_small_and_whole_numbers_are_written_plainly(tmp_path):
    pose = np.array([[-0.0, 1e-7, 3.0, 0, 0, -0.0, 1]])
    write_tum(tmp_path / "a.tum", Trajectory(np.array([0.0]), pose), header=False)
    assert (tmp_path / "a.tum").read_text() == "0.000000 0 1e-07 3 0 0 0 1\n"


def test_an_empty_trajectory_is_a_header(tmp_path):
    write_tum(tmp_path / "a.tum", Trajectory(np.zeros(0), np.zeros((0, 7))))
    assert (tmp_path / "a.tum").read_text().startswith("# timestamp tx ty tz qx qy qz qw")
    with pytest.raises(InputError, match="holds no pose"):
        read_tum(tmp_path / "a.tum")


def test_values_that_are_not_finite_leave_an_older_file_alone(tmp_path):
    path = tmp_path / "a.tum"
    write_tum(path, made_up())
    before = path.read_bytes()
    broken = made_up()
    broken.T_wc[3, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        write_tum(path, broken)
    assert path.read_bytes() == before


def test_a_folder_that_is_not_there_is_a_sentence(tmp_path):
    with pytest.raises(UsageError, match=r"cannot write .*No such file"):
        write_tum(tmp_path / "no" / "a.tum", made_up())


def test_comments_commas_blank_lines_and_byte_order_marks_are_read(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("\ufeff# a comment\n\n1.0, 1,2,3, 0,0,0,1\n2.0\t4 5 6 0 0 0 1 # end\r\n")
    trajectory = read_tum(path)
    assert trajectory.times.tolist() == [1.0, 2.0]
    assert trajectory.centres.tolist() == [[1, 2, 3], [4, 5, 6]]


GOOD = "1.0 0 0 0 0 0 0 1\n"
BAD = [
    ("2.0 0 0 0 0 0 0 1 9\n", "line 2: 9 columns, expected 8"),
    ("2.0 0 0 0 0 0 1\n", "line 2: 7 columns"),
    ("2.0 0 nan 0 0 0 0 1\n", "line 2: 'nan' is not a finite number"),
    ("2.0 0 x 0 0 0 0 1\n", "line 2: 'x' is not a number"),
    ("1.0 0 0 0 0 0 0 1\n", "line 2: time stamp 1.0 repeats"),
    ("0.5 0 0 0 0 0 0 1\n", "line 2: time stamp 0.5 runs backwards from 1.0"),
    ("2.0 0 0 0 0 0 0 0\n", "line 2: the quaternion has length 0"),
    ("2.0 0 0 0 1 1 0 1\n", "line 2: the quaternion has length 1.73"),
]


@pytest.mark.parametrize(("row", "words"), BAD)
def test_a_bad_row_is_refused_with_its_line(tmp_path, row, words):
    path = tmp_path / "a.tum"
    path.write_text(GOOD + row + "3.0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=words) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("row", "words"), BAD)
def test_a_bad_row_is_skipped_and_noted_where_asked_for(tmp_path, row, words):
    path = tmp_path / "a.tum"
    path.write_text(GOOD + row + "3.0 0 0 0 0 0 0 1\n")
    problems: list[str] = []
    assert read_tum(path, problems=problems).times.tolist() == [1.0, 3.0]
    assert len(problems) == 1
    assert words in problems[0]


def test_many_bad_rows_do_not_flood(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text(GOOD + "oh no\n" * 100)
    problems: list[str] = []
    read_tum(path, problems=problems)
    assert len(problems) == 6
    assert problems[-1] == "a.tum: 95 more bad rows skipped"


def test_files_that_are_no_text_or_not_there(tmp_path):
    (tmp_path / "b.tum").write_bytes(bytes(range(256)))
    for path, words in (
        (tmp_path / "no.tum", "no such file"),
        (tmp_path, "is a folder"),
        (tmp_path / "b.tum", "not a text file"),
    ):
        with pytest.raises(InputError, match=words):
            read_tum(path)


def test_one_stray_time_costs_no_other_row(tmp_path):
    rows = [f"{t / 10} {t} 0 0 0 0 0 1" for t in range(300)]
    rows.insert(5, "99999 0 0 0 0 0 0 1")
    rows.insert(50, rows[49])
    file = tmp_path / "truth.tum"
    file.write_text("\n".join(rows) + "\n")
    problems: list[str] = []
    assert len(read_tum(file, problems=problems)) == 300
    assert len(problems) == 2
    assert "line 6: time stamp 99999.0 lies ahead of the rows after it" in problems[0]
    assert "repeats" in problems[1]
    with pytest.raises(InputError, match=r"line 7: time stamp 0\.5 runs backwards from 99999"):
        read_tum(file)


@pytest.mark.parametrize("order", ["backwards", "pieces", "mixed"])
def test_rows_in_another_order_are_put_in_that_of_time(tmp_path, order):
    rows = [f"{t / 10} {t} 0 0 0 0 0 1" for t in range(40)]
    written = {
        "backwards": rows[::-1],
        "pieces": rows[25:] + rows[:25] + rows[30:31],
        "mixed": rows[::2] + rows[1::2],
    }[order]
    file = tmp_path / "other.tum"
    file.write_text("\n".join(written) + "\n")
    problems: list[str] = []
    found = read_tum(file, problems=problems)
    assert found.times.tolist() == [t / 10 for t in range(40)]
    assert found.T_wc[:, 0].tolist() == list(range(40))
    assert problems[0] == "other.tum: rows are not in the order of time; put in that order"
    assert len(problems) == (2 if order == "pieces" else 1)  # and one is there twice
    with pytest.raises(InputError, match="runs backwards"):
        read_tum(file)
