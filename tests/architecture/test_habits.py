"""Habits that hold in every file: size, no prints, nothing unfinished, documented names."""

from __future__ import annotations

import ast
import re

MOST_LINES = 400
UNFINISHED = re.compile(r"\b(TODO|FIXME|XXX|HACK)\b")


def test_files_are_small(host, builtins):
    sizes = {s.where: len(s.text.splitlines()) for s in host + builtins}
    big = {where: lines for where, lines in sizes.items() if lines > MOST_LINES}
    assert not big, f"files over {MOST_LINES} lines: {big}"


def test_nothing_is_unfinished(host, builtins):
    wrong = []
    for source in host + builtins:
        for number, line in enumerate(source.text.splitlines(), 1):
            if UNFINISHED.search(line):
                wrong.append(f"{source.where}:{number}: {line.strip()}")
        if source.module == "droidw.plugin.hookspecs":
            continue  # a hookspec is a signature and a docstring; pluggy never calls its body
        wrong += [
            f"{source.where}:{node.lineno}: NotImplementedError"
            for node in ast.walk(source.tree)
            if isinstance(node, ast.Name) and node.id == "NotImplementedError"
        ]
    assert not wrong, "\n".join(wrong)


def test_only_the_command_line_prints(host, builtins):
    wrong = []
    for source in host + builtins:
        if source.module.startswith("droidw.cli"):
            continue
        for node in ast.walk(source.tree):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id == "print"
            ):
                wrong.append(f"{source.where}:{node.lineno}: print()")
    assert not wrong, "\n".join(wrong)


def test_public_names_have_docstrings(host, builtins):
    wrong = []
    for source in host + builtins:
        if ast.get_docstring(source.tree) is None:
            wrong.append(f"{source.where}: module")
        for node in source.tree.body:
            wrong += [f"{source.where}:{n.lineno}: {n.name}" for n in _undocumented(node)]
    assert not wrong, "without a docstring:\n" + "\n".join(wrong)


def _undocumented(node):
    """A public function or class without a docstring, and the public methods of a class."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    if not isinstance(node, (*functions, ast.ClassDef)) or node.name.startswith("_"):
        return []
    missing = [] if ast.get_docstring(node) else [node]
    if isinstance(node, ast.ClassDef):
        methods = [m for m in node.body if isinstance(m, functions) and not m.name.startswith("_")]
        # a class that declares its bases inherits what those bases say of a method
        if not node.bases:
            missing += [m for m in methods if not ast.get_docstring(m)]
    return missing


def test_no_broad_except_without_a_reason(host, builtins):
    wrong = []
    for source in host + builtins:
        lines = source.text.splitlines()
        for node in ast.walk(source.tree):
            if not isinstance(node, ast.ExceptHandler):
                continue
            caught = "" if node.type is None else ast.unparse(node.type)
            broad = node.type is None or re.search(r"\b(Base)?Exception\b", caught)
            ends_in_raise = isinstance(node.body[-1], ast.Raise)
            if broad and not ends_in_raise and "noqa: BLE001 - " not in lines[node.lineno - 1]:
                wrong.append(f"{source.where}:{node.lineno}: except {caught}")
    assert not wrong, "\n".join(wrong)
