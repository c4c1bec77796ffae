"""The verb table, and how errors become sentences and exit codes."""

from __future__ import annotations

import logging
import subprocess
import sys
import types

import pytest

import droidw
from droidw import errors
from droidw.cli import main as cli
from droidw.cli.main import main
from droidw.cli.options import add_override_argument
from droidw.cli.render import table
from droidw.log import log_to_file


@pytest.fixture
def verb(monkeypatch):
    """A verb that does what the test says."""

    def make(action):
        module = types.ModuleType("droidw_test_verb")
        module.HELP = "does as it is told"

        def add_arguments(parser):
            parser.add_argument("source")
            parser.add_argument("-o", "--out")
            add_override_argument(parser)

        module.add_arguments, module.main = add_arguments, action
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(cli, "VERBS", {"act": module.__name__})

    return make


def raising(error):
    def action(args):
        raise error

    return action


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"droidw {droidw.__version__}\n"


@pytest.mark.parametrize(("arguments", "code"), [(["-h"], 0), (["--help"], 0), ([], 2)])
def test_help_lists_the_verbs(verb, capsys, arguments, code):
    verb(lambda args: 0)
    assert main(arguments) == code
    text = capsys.readouterr().out
    assert "  act  does as it is told" in text
    assert "exit codes: 0 done" in text


def test_help_of_a_verb(verb, capsys):
    verb(lambda args: 0)
    for arguments in (["act", "-h"], ["-h", "act"]):
        assert main(arguments) == 0
        assert "usage: droidw act" in capsys.readouterr().out


def test_unknown_verb(capsys):
    assert main(["list-plugin"]) == 2
    assert capsys.readouterr().err == (
        "droidw: error: there is no command 'list-plugin'\n"
        f"  did you mean 'list-plugins'?   commands: {', '.join(cli.VERBS)}\n"
    )


def test_unknown_option(verb, capsys):
    verb(lambda args: 0)
    assert main(["act", "x", "--colour"]) == 2
    assert "droidw act: error: unrecognized arguments: --colour" in capsys.readouterr().err


def test_what_is_missing_is_named_alone(verb, capsys):
    verb(lambda args: 0)
    assert main(["act", "-o", "runs/a"]) == 2
    assert "arguments are required: source\n" in capsys.readouterr().err


def test_overrides_may_follow_options(verb):
    seen = []
    verb(lambda args: seen.append((args.source, args.out, args.overrides, args.verbose)) or 0)
    assert main(["-v", "act", "clip.mp4", "-o", "runs/a", "-v", "a=1", "b.c=2"]) == 0
    assert seen == [("clip.mp4", "runs/a", ["a=1", "b.c=2"], 2)]


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.ConfigError("no", "try\nthis"), 2),
        (errors.InputError("no", "try\nthis"), 3),
        (errors.TrackingError("no", "try\nthis"), 4),
        (errors.MissingRequirementError("no", "try\nthis"), 5),
        (errors.Interrupted("no", 15, "try\nthis"), 143),
    ],
)
def test_known_errors_are_sentences(verb, capsys, error, code):
    verb(raising(error))
    assert main(["act", "x"]) == code
    assert capsys.readouterr().err == "droidw: error: no\n  try\n  this\n"


def test_unknown_errors_keep_their_traceback(verb, capsys):
    verb(raising(ZeroDivisionError("division by zero")))
    assert main(["act", "a b"]) == 1
    text = capsys.readouterr().err
    assert "Traceback (most recent call last)" in text
    assert "droidw: error: ZeroDivisionError: division by zero" in text
    assert "the command (droidw act 'a b')" in text


def test_ctrl_c(verb, capsys):
    verb(raising(KeyboardInterrupt()))
    assert main(["act", "x"]) == 130
    assert capsys.readouterr().err == "droidw: interrupted\n"


def test_a_reader_that_leaves_is_no_error():
    done = subprocess.run(
        f"{sys.executable} -m droidw list-plugins | head -c 1",
        shell=True, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stderr == ""


def test_messages_by_verbosity(verb, capsys):
    def action(args):
        logger = logging.getLogger("droidw.test")
        logger.info("information")
        logger.warning("something odd")
        return 0

    verb(action)
    expected = {
        "-q": "", "-v": "information\ndroidw: warning: something odd\n",
    }  # fmt: skip
    for option, text in expected.items():
        assert main(["act", "x", option]) == 0
        assert capsys.readouterr().err == text
    assert main(["act", "x"]) == 0
    assert capsys.readouterr().err == "droidw: warning: something odd\n"


def test_log_file(tmp_path):
    path = tmp_path / "log.txt"
    with log_to_file(path):
        logging.getLogger("droidw_plugins.flow").info("inside")
    logging.getLogger("droidw_plugins.flow").warning("outside")
    (line,) = path.read_text().splitlines()
    assert line.endswith("INFO droidw_plugins.flow: inside")


def test_table_is_cut_to_the_terminal():
    rows = [("a", "x" * 50, "end"), ("bb", "short", "")]
    assert table(rows, indent=2, width=40).splitlines() == [
        "  a   " + "x" * 26 + "...  end",
        "  bb  short",
    ]
