"""Implementation of correspondence `droid`."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from droidw.errors import ConfigError, InputError
from droidw.geometry.projective import pixel_grid
from droidw.geometry.transfer import upload
from droidw.interfaces.correspondence import Motion, Purpose
from droidw.solve.weights import unmasked
from droidw_plugins.correspondence._droid_corr import Pyramid, lookup_lowmem, smallest_side
from droidw_plugins.correspondence._droid_session import DroidSession

if TYPE_CHECKING:
    from droidw.geometry.camera import Grid
    from droidw.slam.frame import Frame
    from droidw_plugins.correspondence._droid_net import DroidNet
    from droidw_plugins.correspondence._droid_update import Still
    from droidw_plugins.correspondence.droid import DroidOptions

__all__ = ["DroidCorrespondence", "DroidFrame", "DroidKeyframe"]

STRIDE = 8


@dataclass(frozen=True, eq=False)
class DroidFrame:
    """Payload of any frame.

    Attributes:
        fmap: features [128,h,w] in the precision of the store.
        seen: bool [h,w], cells that the frame's mask leaves; None: all of them.
    """

    index: int
    fmap: Tensor
    seen: Tensor | None = field(default=None, kw_only=True)


@dataclass(frozen=True, eq=False)
class DroidKeyframe(DroidFrame):
    """Payload of a keyframe: besides, initial hidden state and context, each [128,h,w]."""

    net: Tensor
    inp: Tensor


class DroidCorrespondence:
    """The DROID network behind the interface of correspondence (REFERENCE 1 and 5.1).

    The grid has stride 8 and offset 0: intrinsics of the grid are those of the picture divided
    by 8, as published, and that is where the receptive fields of the encoders are centred.

    Args:
        net: the network, on `device`.
        options: see `DroidOptions`.
        device: where tensors live.
        published: reproduce the published slips (`compat: [droid-w]`): hidden state and context of
            the very first keyframe are their first channel, and the border of an upsampled map is
            pulled towards 0.
    Raises:
        ConfigError: this precision is not to be had on this device.
    """

    stride = STRIDE
    offset = 0.0

    def __init__(
        self,
        net: DroidNet,
        options: DroidOptions,
        device: torch.device,
        published: bool = False,
    ) -> None:
        if options.precision == "float16" and device.type != "cuda":
            raise ConfigError(
                f"correspondence.options.precision: float16 is for GPUs, and this runs on {device}",
                "valid on a CPU: auto, float32, bfloat16",
            )
        self.net = net
        self.options = options
        self.device = device
        self.published = published
        mixed = {"float32": None, "bfloat16": torch.bfloat16, "float16": torch.float16}
        auto = torch.float16 if device.type == "cuda" else None
        self.mixed = auto if options.precision == "auto" else mixed[options.precision]
        self.stored = torch.float16 if options.store == "half" else torch.float32
        self._first = True
        self._latest: DroidKeyframe | None = None
        self._still: tuple[DroidKeyframe, Still] | None = None

    def computing(self) -> AbstractContextManager[Any]:
        """The precision of the network, as a context."""
        return torch.autocast(
            self.device.type, dtype=self.mixed or torch.bfloat16, enabled=self.mixed is not None
        )

    def working(self, stored: Tensor) -> Tensor:
        """A stored tensor as the network takes it."""
        return stored if self.mixed == torch.float16 else stored.float()

    @torch.no_grad()
    def encode(self, frame: Frame, grid: Grid) -> DroidFrame:
        """Features of one frame.

        Raises:
            InputError: the picture is too small, or a side is no multiple of 8.
        """
        height, width = frame.image.shape[-2:]
        _check_size(height, width)
        with self.computing():
            features = self.net.features(self._image(frame))
        seen = None
        if frame.mask is not None:
            seen = unmasked(grid.covered(upload(frame.mask, self.device))) > 0
        return DroidFrame(frame.index, features[0].to(self.stored).contiguous(), seen=seen)

    @torch.no_grad()
    def context(self, payload: DroidFrame, frame: Frame, grid: Grid) -> DroidKeyframe:
        """Features, hidden state and context of a keyframe; motion is measured from it next."""
        with self.computing():
            net, inp = self.net.context(self._image(frame))
        net, inp = (x[0].to(self.stored).contiguous() for x in (net, inp))
        keyframe = DroidKeyframe(payload.index, payload.fmap, net, inp, seen=payload.seen)
        self._latest = keyframe
        first, self._first = self._first, False
        if first and self.published:
            # The published code stores one channel here, which then stands for all 128.
            net, inp = (x[:1].expand_as(x) for x in (net, inp))
            return replace(keyframe, net=net, inp=inp)
        return keyframe

    @torch.no_grad()
    def motion(self, reference: DroidFrame, current: DroidFrame) -> Motion:
        """Mean flow of one round of the update operator on the pair (REFERENCE 5.1).

        Cells that the mask of either picture covers have no say in it. The network does not say
        what it could match: `matched` is 1, or 0 where nothing is left.

        Raises:
            ValueError: `context` was never asked for `reference`.
        """
        keyframe = self._with_context(reference)
        height, width = current.fmap.shape[-2:]
        pyramid = Pyramid(height, width)
        grid = pixel_grid(height, width, device=self.device)
        pair = self.working(keyframe.fmap), pyramid.features(self.working(current.fmap))
        corr = lookup_lowmem([pair], grid[None], pyramid)
        update = self.net.update
        with self.computing():
            if self._still is None or self._still[0] is not keyframe:
                net, inp = (self.working(x)[None] for x in (keyframe.net, keyframe.inp))
                self._still = keyframe, update.still(_last(net), _last(inp))
            delta = update.drift(self._still[1], corr)
        length = delta.norm(dim=-1)
        seen = [mask for mask in (reference.seen, current.seen) if mask is not None]
        if not seen:
            return Motion(float(length.mean()), 1.0)
        left = torch.stack(seen).all(0)
        moved, count = torch.stack([(length * left).sum(), left.sum().to(length)]).tolist()
        return Motion(moved / max(count, 1.0), min(count, 1.0))

    def session(self, purpose: Purpose = "window") -> DroidSession:
        """Fresh hidden states; "global" keeps no correlation, "fill" gives no damping."""
        return DroidSession(self, purpose)

    def _with_context(self, frame: DroidFrame) -> DroidKeyframe:
        latest = self._latest
        if latest is not None and latest.fmap is frame.fmap:
            return latest
        if isinstance(frame, DroidKeyframe):
            return frame
        raise ValueError(f"motion: frame {frame.index} has no context: it was never a candidate")

    def _image(self, frame: Frame) -> Tensor:
        return upload(frame.image, self.device)[None]


def _last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def _check_size(height: int, width: int) -> None:
    least = STRIDE * smallest_side()
    if min(height, width) < least:
        raise InputError(
            f"pictures of {width}x{height} px are too small for the DROID network",
            f"each side must have {least} px at least: enlarge camera.long_side or camera.size",
        )
    if height % STRIDE or width % STRIDE:
        w, h = (max(least, round(side / STRIDE) * STRIDE) for side in (width, height))
        raise InputError(
            f"pictures of {width}x{height} px do not suit the DROID network: both sides must be "
            f"multiples of {STRIDE}",
            f"set camera.size to [{w},{h}], or to [] and camera.long_side instead",
        )
