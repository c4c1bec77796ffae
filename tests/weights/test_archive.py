"""Archives never write outside their folder."""

from __future__ import annotations

import io
import shutil
import tarfile
import zipfile
from collections import namedtuple

import pytest

from droidw.errors import InputError, UsageError
from droidw.io.download_archive import unpack


def make_zip(path, files, links=()):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
        for name in links:
            info = zipfile.ZipInfo(name)
            info.external_attr = 0o120777 << 16
            archive.writestr(info, "/etc/passwd")
    return path


def make_tar(path, files, links=()):
    with tarfile.open(path, "w:gz") as archive:
        for name, text in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(text)
            archive.addfile(info, io.BytesIO(text.encode()))
        for name in links:
            info = tarfile.TarInfo(name)
            info.type, info.linkname = tarfile.SYMTYPE, "/etc/passwd"
            archive.addfile(info)
    return path


KINDS = pytest.mark.parametrize("make", [make_zip, make_tar])
TREE = {"seq/rgb.txt": "1 a", "seq/rgb/a.png": "picture", "__MACOSX/junk": "x"}


@KINDS
def test_a_tree_comes_whole(make, tmp_path):
    seen = []
    tops = unpack(make(tmp_path / "a", TREE), tmp_path / "out", progress=lambda *x: seen.append(x))
    assert tops == [tmp_path / "out" / "seq"]
    assert (tops[0] / "rgb" / "a.png").read_text() == "picture"
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["seq"]
    assert seen[-1] == (10, 10)


@KINDS
def test_a_part_of_it_joins_what_is_there(make, tmp_path):
    files = {"all/one/a": "1", "all/two/b": "2", "all/videos/c": "3"}
    archive = make(tmp_path / "a", files)
    unpack(archive, tmp_path, below="all/one")
    assert not (tmp_path / "all" / "two").exists()
    (tmp_path / "all" / "one" / "mine").write_text("kept")
    unpack(archive, tmp_path, below="all/")
    assert (tmp_path / "all" / "two" / "b").read_text() == "2"
    assert (tmp_path / "all" / "one" / "mine").read_text() == "kept"
    with pytest.raises(InputError, match="no file below other"):
        unpack(archive, tmp_path, below="other")


@KINDS
@pytest.mark.parametrize("name", ["../evil", "a/../../evil", "/tmp/evil", "C:\\evil", "..\\evil"])
def test_nothing_is_written_outside(make, name, tmp_path):
    archive = make(tmp_path / "a", {"fine": "1", name: "evil"})
    with pytest.raises(InputError, match="outside its folder"):
        unpack(archive, tmp_path / "out")
    assert not (tmp_path / "out").exists() and not (tmp_path / "evil").exists()


@KINDS
def test_links_are_refused(make, tmp_path):
    with pytest.raises(InputError, match="a link or a device"):
        unpack(make(tmp_path / "a", {"fine": "1"}, links=["door"]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@KINDS
def test_a_damaged_archive(make, tmp_path):
    path = make(tmp_path / "a", {"big": "text " * 5000 + "x"})
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match="cut short, damaged or no archive"):
        unpack(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_damage_inside_a_zip(tmp_path):
    path = make_zip(tmp_path / "a", {"one": "1" * 4000})
    data = bytearray(path.read_bytes())
    data[40] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        unpack(path, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_what_will_not_fit_is_not_begun(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 10, 5))
    with pytest.raises(UsageError, match="the disk is full"):
        unpack(make_zip(tmp_path / "a", TREE), tmp_path / "out")
