"""What cannot be written is told in a sentence, and leaves nothing behind."""

from __future__ import annotations

import pytest

from droidw.errors import UsageError
from droidw.io.files import write_text


@pytest.mark.parametrize("name", ["file/below.txt", "n" * 300, "missing/file.txt"])
def test_paths_that_cannot_be(tmp_path, name):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="cannot write"):
        write_text(tmp_path / name, "text")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
