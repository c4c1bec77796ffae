"""Write docs/images/demo.jpg, the picture of the README, from what `droidw demo` leaves.

    droidw demo -o DIR && python docs/make_picture.py DIR

All of it is rendered by droidw: a keyframe, what uncertainty took out of it, its depth,
and the static cloud with the path of the camera.
"""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]
KEYFRAME, WIDTH, GAP = 12, 1080, 12
OUT = Path(__file__).resolve().parent / "images" / "demo.jpg"


def pictures(page: str, alt: str) -> list[Picture]:
    """The pictures of a report whose description contains `alt`, in its order."""
    found = re.findall(r'<img src="data:image/[a-z]+;base64,([^"]+)"[^>]*alt="([^"]*)"', page)
    data = [np.frombuffer(base64.b64decode(code), np.uint8) for code, said in found if alt in said]
    return [on_white(np.asarray(cv2.imdecode(part, cv2.IMREAD_UNCHANGED))) for part in data]


def on_white(picture: npt.NDArray[np.generic]) -> Picture:
    """The colours of a picture, with what is transparent in it white."""
    colours = picture[..., :3].astype(np.float32)
    if picture.shape[-1] == 4:
        share = picture[..., 3:].astype(np.float32) / 255
        colours = share * colours + (1 - share) * 255
    return np.rint(colours).astype(np.uint8)


def row(parts: list[Picture], width: int) -> Picture:
    """Pictures beside one another, all as high, with white between them."""
    shares = [part.shape[1] / part.shape[0] for part in parts]
    height = round((width - GAP * (len(parts) - 1)) / sum(shares))
    line = np.full((height, width, 3), 255, np.uint8)
    left = 0
    for part, share in zip(parts, shares, strict=True):
        last = part is parts[-1]
        wide = width - left if last else round(height * share)
        line[:, left : left + wide] = cv2.resize(
            part, (wide, height), interpolation=cv2.INTER_CUBIC
        )
        left += wide + GAP
    return line


def main(folder: Path) -> None:
    """Compose the picture."""
    page = (folder / "run" / "report.html").read_text(encoding="utf-8")
    overlay = pictures(page, f"keyframe {KEYFRAME} with")[0]
    depth = pictures(page, f"depth of keyframe {KEYFRAME}")[0]
    index = re.search(rf"#{KEYFRAME} · frame (\d+)", page)
    assert index is not None
    frames = sorted((folder / "footage" / "rgb").iterdir())
    picture = cv2.imread(str(frames[int(index[1])]), cv2.IMREAD_COLOR)
    assert picture is not None
    top = row([np.asarray(picture, np.uint8), overlay, depth], WIDTH)
    bottom = row(pictures(page, "point cloud"), WIDTH)
    between = np.full((GAP, WIDTH, 3), 255, np.uint8)
    OUT.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(OUT), np.vstack([top, between, bottom]), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
