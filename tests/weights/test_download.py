"""`download` against a server that breaks off, changes its mind, or answers with a page."""

from __future__ import annotations

import errno
import fcntl
import random
import shutil
from collections import namedtuple

import pytest

from droidw.errors import MissingRequirementError, UsageError
from droidw.io import download as module
from droidw.io.download import DownloadError, download

DATA = random.Random(1).randbytes(700_000)


def fetch(urls, target, **options):
    urls = [urls] if isinstance(urls, str) else urls
    return download(urls, target, pause=0.0, timeout=10.0, **options)


def leftovers(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_whole_file(site, tmp_path):
    target = tmp_path / "new" / "net.pth"
    seen = []
    got = fetch(site.serve("/net.pth", DATA), target, progress=lambda *now: seen.append(now))
    assert target.read_bytes() == DATA
    assert (got.path, got.size, got.sha256) == (target, len(DATA), site.files["/net.pth"].sha256)
    assert seen[-1] == (len(DATA), len(DATA)) and seen == sorted(seen)
    assert leftovers(target.parent) == ["net.pth"]


def test_a_broken_connection_is_gone_on_with(site, tmp_path):
    url = site.serve("/net.pth", DATA, break_after=[300_000, 100_000])
    got = fetch(url, tmp_path / "net.pth", sha256="")
    assert got.path.read_bytes() == DATA
    assert site.asked("Range") == [None, "bytes=300000-", "bytes=400000-"]


@pytest.mark.parametrize("sha256", ["", "of the file"])
def test_a_file_without_a_length_that_breaks_off_is_not_complete(site, tmp_path, sha256):
    url = site.serve("/net.pth", DATA, chunked=True, break_after=[300_000, 100_000])
    wanted = site.files["/net.pth"].sha256 if sha256 else ""
    assert fetch(url, tmp_path / "net.pth", sha256=wanted).path.read_bytes() == DATA
    assert site.asked("Range") == [None, "bytes=300000-", "bytes=400000-"]


def test_the_next_call_goes_on_where_the_last_stopped(site, tmp_path):
    url = site.serve("/net.pth", DATA, break_after=[200_000])
    with pytest.raises(DownloadError, match="broke after 200000 of 700000 bytes"):
        fetch(url, tmp_path / "net.pth", attempts=1)
    assert leftovers(tmp_path) == ["net.pth.part", "net.pth.part.json"]
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA
    assert site.asked("Range")[-1] == "bytes=200000-" and site.asked("If-Range")[-1] == '"v1"'
    assert leftovers(tmp_path) == ["net.pth"]


def test_what_has_changed_since_is_not_mixed_with_the_old(site, tmp_path):
    url = site.serve("/net.pth", DATA, break_after=[200_000])
    with pytest.raises(DownloadError):
        fetch(url, tmp_path / "net.pth", attempts=1)
    other = DATA[::-1]
    site.serve("/net.pth", other, tag='"v2"')
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == other


def test_without_a_mark_of_the_version_the_next_call_begins_anew(site, tmp_path):
    url = site.serve("/net.pth", DATA, tag="", break_after=[200_000])
    with pytest.raises(DownloadError):
        fetch(url, tmp_path / "net.pth", attempts=1)
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA
    assert site.asked("Range") == [None, None]


def test_a_server_that_cannot_go_on_sends_all_again(site, tmp_path):
    url = site.serve("/net.pth", DATA, ranges=False, break_after=[200_000])
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA


def test_a_part_that_was_complete_is_taken(site, tmp_path, monkeypatch):
    url = site.serve("/net.pth", DATA)
    with monkeypatch.context() as patch:
        patch.setattr(module.os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            fetch(url, tmp_path / "net.pth")
        # a session that ended just before the rename leaves its notes behind
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA
    assert site.asked("Range") == [None, "bytes=700000-"]


def test_a_wrong_hash_leaves_nothing(site, tmp_path):
    url = site.serve("/net.pth", DATA)
    with pytest.raises(DownloadError, match="is not the file that its authors publish") as error:
        fetch(url, tmp_path / "net.pth", sha256="ab" * 32)
    assert "ab" * 32 in error.value.message and site.files["/net.pth"].sha256 in str(error.value)
    assert leftovers(tmp_path) == []


def test_the_hash_that_a_redirecting_server_states_is_held_to(site, tmp_path):
    site.serve("/blob", DATA)
    told = {"Location": "/blob", "X-Linked-Etag": f'"{"0" * 64}"'}
    url = site.serve("/resolve", status=302, headers=told)
    with pytest.raises(DownloadError, match="SHA-256"):
        fetch(url, tmp_path / "net.pth")
    told["X-Linked-Etag"] = f'"{site.files["/blob"].sha256}"'
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA


def test_the_second_address_helps_out(site, tmp_path):
    urls = [f"{site.root}/gone", site.serve("/net.pth", DATA)]
    assert fetch(urls, tmp_path / "net.pth").url == urls[1]
    with pytest.raises(DownloadError, match="404"):
        fetch(urls[:1], tmp_path / "other.pth")


def test_what_came_from_one_address_outlasts_another_that_has_nothing(site, tmp_path):
    urls = [f"{site.root}/gone", site.serve("/net.pth", DATA, break_after=[200_000])]
    urls.append(f"{site.root}/gone-too")
    with pytest.raises(DownloadError, match=r"404.*broke after 200000 .*404") as error:
        fetch(urls, tmp_path / "net.pth", attempts=1)
    assert "it goes on where it stopped" in error.value.hint
    asked = len(site.requests)
    got = fetch(urls, tmp_path / "net.pth")
    assert got.url == urls[1] and got.path.read_bytes() == DATA
    assert site.asked("Range")[asked:] == ["bytes=200000-"]
    assert leftovers(tmp_path) == ["net.pth"]


def test_what_came_from_one_address_is_not_mixed_with_what_another_sends(site, tmp_path):
    other = DATA[::-1]
    one = site.serve("/net.pth", DATA, break_after=[200_000])
    urls = [one, site.serve("/other.pth", other)]
    got = fetch(urls, tmp_path / "net.pth", attempts=1)
    assert got.url == urls[1] and got.path.read_bytes() == other
    assert site.asked("Range") == [None, None]


def test_a_busy_server_is_asked_again_but_not_forever(site, tmp_path):
    url = site.serve("/net.pth", status=503)
    with pytest.raises(DownloadError, match=r"answers 503 .*, 3 times in a row"):
        fetch(url, tmp_path / "net.pth", attempts=3)
    assert len(site.requests) == 3


def test_no_server_at_all(tmp_path):
    with pytest.raises(DownloadError, match="no connection"):
        fetch("http://127.0.0.1:9/net.pth", tmp_path / "net.pth", attempts=2)


def test_a_web_page_is_no_file(site, tmp_path):
    page = "<!DOCTYPE html><html><head><title>Sign in</title></head></html>"
    url = site.serve("/net.pth", page.encode())
    with pytest.raises(DownloadError, match=r"a web page instead of the file \('Sign in'\)"):
        fetch(url, tmp_path / "net.pth")
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize(
    "page",
    [
        '<html><title>Google Drive - Virus scan warning</title><form id="download-form" '
        'action="{root}/uc"><input type="hidden" name="id" value="7"><input name="confirm" '
        'value="t"><input type="submit" value="Download anyway"></form></html>',
        '<html><a href="/uc?id=7&amp;confirm=t">Download anyway</a></html>',
    ],
)
def test_the_question_about_large_files_is_answered(site, tmp_path, page):
    url = site.serve("/uc", DATA, page=page.format(root=site.root)) + "?id=7"
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA
    path, _, query = site.requests[-1][0].partition("?")
    assert path == "/uc" and {"id=7", "confirm=t"} <= set(query.split("&"))


def test_a_full_quota_is_said(site, tmp_path):
    page = "<html><title>Google Drive - Quota exceeded</title></html>"
    with pytest.raises(DownloadError, match="Quota exceeded"):
        fetch(site.serve("/uc", DATA, page=page), tmp_path / "net.pth")


def test_a_confirmation_never_leads_to_another_site(site, tmp_path):
    page = '<html><form action="http://127.0.0.2/x"><input name="confirm" value="t"></form></html>'
    with pytest.raises(DownloadError, match="web page"):
        fetch(site.serve("/uc", DATA, page=page), tmp_path / "net.pth")


def test_a_full_disk_is_said_and_gone_on_from(site, tmp_path, monkeypatch):
    url = site.serve("/net.pth", DATA)
    blocks = []

    def write(stream, block):
        if len(blocks) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        blocks.append(stream.write(block))

    with monkeypatch.context() as patch:
        patch.setattr(module._Transfer, "_write", staticmethod(write))
        with pytest.raises(UsageError, match="the disk is full") as error:
            fetch(url, tmp_path / "net.pth")
    assert "make room" in error.value.hint
    assert fetch(url, tmp_path / "net.pth").path.read_bytes() == DATA
    assert site.asked("Range")[-1] == f"bytes={blocks[0]}-"


def test_what_will_not_fit_is_not_begun(site, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 10, 5))
    with pytest.raises(UsageError, match="the disk is full"):
        fetch(site.serve("/net.pth", DATA), tmp_path / "net.pth")


def test_a_folder_that_cannot_be_made(site, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="cannot write"):
        fetch(site.serve("/net.pth", DATA), tmp_path / "file" / "net.pth")


@pytest.mark.parametrize("how", ["argument", "variable"])
def test_offline_nothing_is_asked_for(site, tmp_path, monkeypatch, how):
    url = site.serve("/net.pth", DATA)
    if how == "variable":
        monkeypatch.setenv("DROIDW_OFFLINE", "1")
    with pytest.raises(MissingRequirementError, match="forbids downloading") as error:
        fetch(url, tmp_path / "net.pth", offline=how == "argument")
    assert url in error.value.hint and site.requests == [] and leftovers(tmp_path) == []


def test_only_the_web_is_asked(site, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("x")
    with pytest.raises(DownloadError, match="no http or https address"):
        fetch(secret.as_uri(), tmp_path / "net.pth")
    url = site.serve("/net.pth", status=302, headers={"Location": "ftp://127.0.0.1/net.pth"})
    with pytest.raises(DownloadError, match="not safe"):
        fetch(url, tmp_path / "net.pth")


def test_two_processes_do_not_write_one_file(site, tmp_path):
    with (tmp_path / "net.pth.part").open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DownloadError, match="by another process"):
            fetch(site.serve("/net.pth", DATA), tmp_path / "net.pth")
