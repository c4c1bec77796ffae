"""Web pages that come where a file should: telling them apart, and Google Drive's question."""

from __future__ import annotations

import urllib.parse
from html.parser import HTMLParser

__all__ = ["confirmed_link", "looks_like_html", "page_title"]


def looks_like_html(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a web page."""
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")[:200].lower()
    if start.startswith(b"<!--"):
        return b"<html" in head.lower()
    return start.startswith((b"<!doctype html", b"<html", b"<head"))


def page_title(page: str) -> str:
    """The title of a web page, or ""."""
    return " ".join(_Page(page).title.split())


def confirmed_link(url: str, page: str) -> str:
    """Where "download anyway" of a page leads, or "" if there is no such thing in it.

    Google Drive asks so before it hands out a file that is too large for its virus scan: with a
    form of hidden fields, or in earlier years with a link. Only links to the same site count.
    """
    found = _Page(page)
    if found.form and any(name == "confirm" for name, _ in found.fields):
        link = urllib.parse.urljoin(url, found.form)
        separator = "&" if urllib.parse.urlsplit(link).query else "?"
        link += separator + urllib.parse.urlencode(found.fields)
    elif found.link:
        link = urllib.parse.urljoin(url, found.link)
    else:
        return ""
    here, there = urllib.parse.urlsplit(url), urllib.parse.urlsplit(link)
    same = here.scheme == there.scheme and _site(here.hostname) == _site(there.hostname)
    return link if same else ""


def _site(host: str | None) -> str:
    """Hosts of Google count as one site, and so do google.com and googleusercontent.com."""
    name = host or ""
    google = name.endswith((".google.com", ".googleusercontent.com"))
    return "google" if google else name


class _Page(HTMLParser):
    """Title, form and confirmation link of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.title = self.form = self.link = ""
        self.fields: list[tuple[str, str]] = []
        self._in_title = self._in_form = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "title":
            self._in_title = True
        elif tag == "form" and not self.form:
            self.form, self._in_form = given.get("action", ""), True
        elif tag == "input" and self._in_form and given.get("name"):
            self.fields.append((given["name"], given.get("value", "")))
        elif tag == "a" and "confirm=" in given.get("href", "") and not self.link:
            self.link = given["href"]

    def handle_endtag(self, tag: str) -> None:
        if tag == "title":
            self._in_title = False
        elif tag == "form":
            self._in_form = False

    def handle_data(self, data: str) -> None:
        if self._in_title:
            self.title += data
