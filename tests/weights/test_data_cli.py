"""`droidw data`: the list, and fetching from a server on the loopback interface."""

from __future__ import annotations

import io
import json
import tarfile
import zipfile

import pytest

from droidw.cli.main import main
from droidw.errors import InputError
from droidw.io import dataset_tables
from droidw.io.dataset_tables import load_table
from droidw.io.download_data import fetch_sequence


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("DROIDW_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture
def mirror(site, monkeypatch):
    """The addresses of the tables, moved to the loopback interface."""
    found = dataset_tables._sequence

    def moved(*args):
        row = found(*args)
        archive = row.archive and f"{site.root}/{row.archive.rpartition('/')[2]}"
        return dataset_tables.replace(row, archive=archive)

    monkeypatch.setattr(dataset_tables, "_sequence", moved)
    return site


def zipped(files):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return data.getvalue()


def tarred(files):
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:gz") as archive:
        for name, text in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(text)
            archive.addfile(info, io.BytesIO(text.encode()))
    return data.getvalue()


def test_list(capsys, root):
    (root / "Bonn" / "rgbd_bonn_crowd").mkdir(parents=True)
    assert main(["data", "list"]) == 0
    text = capsys.readouterr().out
    assert "bonn:balloon" in text and "published ATE 2.6 cm" in text and str(root) in text
    assert main(["data", "list", "bonn", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert len(facts["sequences"]) == 8
    there = {row["source"]: row["present"] for row in facts["sequences"]}
    assert there["bonn:crowd"] and not there["bonn:balloon"]
    assert all(row["archive"].startswith("https://") for row in facts["sequences"])
    assert main(["data", "list", "bon"]) == 3
    assert "did you mean 'bonn'" in capsys.readouterr().err


def test_fetch_a_zip_that_breaks_off(mirror, root, capsys):
    data = zipped({"rgbd_bonn_balloon/rgb.txt": "1 a", "rgbd_bonn_balloon/rgb/a.png": "x" * 9999})
    mirror.serve("/rgbd_bonn_balloon.zip", data, break_after=[len(data) // 2])
    assert main(["data", "fetch", "bonn:balloon", "-q"]) == 0
    folder = root / "Bonn" / "rgbd_bonn_balloon"
    assert (folder / "rgb" / "a.png").read_text() == "x" * 9999
    assert "ReFusion" in capsys.readouterr().out
    assert sorted(p.name for p in root.iterdir()) == ["Bonn", "downloads.json"]
    assert main(["data", "fetch", "bonn:balloon"]) == 0
    assert "was there already" in capsys.readouterr().out and len(mirror.requests) == 2


def test_what_came_first_is_what_must_come_again(mirror, root, capsys):
    first = zipped({"rgbd_bonn_crowd/rgb.txt": "1 a"})
    mirror.serve("/rgbd_bonn_crowd.zip", first)
    row = load_table("bonn").sequence("crowd")
    folder, came = fetch_sequence(row, root, keep=True)
    assert came and (root / "rgbd_bonn_crowd.zip").read_bytes() == first
    (folder / "rgb.txt").unlink()
    folder.rmdir()
    assert fetch_sequence(row, root) == (folder, True)
    assert len(mirror.requests) == 1  # the archive that was kept serves
    (folder / "rgb.txt").unlink()
    folder.rmdir()
    mirror.serve("/rgbd_bonn_crowd.zip", zipped({"rgbd_bonn_crowd/rgb.txt": "2 b"}), tag='"v2"')
    assert main(["data", "fetch", "bonn:crowd"]) == 5
    assert "not the file that came from there before" in capsys.readouterr().err


def test_fetch_a_tar_and_all_of_a_dataset(mirror, root):
    name = "rgbd_dataset_freiburg3_walking_xyz"
    mirror.serve(f"/{name}.tgz", tarred({f"{name}/rgb.txt": "1 a"}))
    assert main(["data", "fetch", "tum:f3/wx", "-q"]) == 0
    assert (root / "TUM_RGBD" / name / "rgb.txt").is_file()
    files = {f"DROID-W/downtown{n}/images_anonymized/1.jpg": "x" for n in range(1, 8)}
    mirror.serve("/DROID-W.zip", zipped({**files, "DROID-W/videos_mp4/1.mp4": "large"}))
    before = len(mirror.requests)
    assert main(["data", "fetch", "droidw", "-q"]) == 0
    assert len(mirror.requests) == before + 1  # one archive holds them all
    assert sorted(p.name for p in (root / "DROID-W").iterdir()) == [
        f"downtown{n}" for n in range(1, 8)
    ]


def test_an_archive_that_reaches_outside_is_refused(mirror, root, capsys):
    mirror.serve("/rgbd_bonn_balloon.zip", zipped({"../../evil": "x", "rgbd_bonn_balloon/a": "x"}))
    assert main(["data", "fetch", "bonn:balloon", "-q"]) == 3
    assert "outside its folder" in capsys.readouterr().err
    assert not (root.parent / "evil").exists() and not (root / "Bonn").exists()


def test_another_layout_is_told(mirror, root):
    mirror.serve("/rgbd_bonn_balloon.zip", zipped({"other/a": "x"}))
    with pytest.raises(InputError, match="its authors have changed its layout"):
        fetch_sequence(load_table("bonn").sequence("balloon"), root)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["fetch"], 2, "nothing is named"),
        (["fetch", "bonn:baloon"], 3, "did you mean 'bonn:balloon'"),
        (["fetch", "nowhere:x"], 3, "datasets: bonn"),
        (["fetch", "dycheck:apple"], 3, "by hand from https://drive.google.com"),
        (["fetch", "bonn:balloon", "--offline"], 5, "--offline forbids"),
        (["fetch", "bonn:balloon"], 5, "404"),
    ],
)
def test_mistakes_are_told(mirror, capsys, arguments, code, said):
    assert main(["data", *arguments]) == code
    assert said in capsys.readouterr().err
