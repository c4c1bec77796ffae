"""What the learned models share: features as rows, pairs of cells, and the gradient of the loss."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from droidw.errors import ConfigError
from droidw.geometry.transfer import on_device, upload
from droidw.interfaces.uncertainty import StoreField, UncertaintyReport, UncertaintyView
from droidw_plugins.uncertainty import _objective as objective
from droidw_plugins.uncertainty._matches import MatchScale, matches
from droidw_plugins.uncertainty._native import Kernels, load_kernels
from droidw_plugins.uncertainty._options import ObjectiveOptions
from droidw_plugins.uncertainty._published import Publisher

__all__ = ["Consistency", "Numbers"]

_ROWS = "consistency_rows"
_LENGTHS = "consistency_lengths"
_SERIAL = "consistency_serial"


@dataclass
class _Pairs:
    """Samples and residuals of one set of edges, kept for `refresh` steps.

    `first` and `last` bound the keyframes that take part; rows count from `first`. `inside` and
    `similar` are numbers of pairs, scalars where the run computes.
    """

    edges: list[tuple[int, int]]
    first: int
    last: int
    counts: Tensor
    samples: objective.Samples
    rho: Tensor
    inside: Tensor
    similar: Tensor
    age: int = 0


class Numbers:
    """Numbers of one step that wait to be read, since each reading waits for a GPU."""

    def __init__(self, **scalars: Tensor) -> None:
        self._scalars = scalars

    def read(self, **more: Tensor) -> tuple[UncertaintyReport, dict[str, float]]:
        """Read all of them at once, and others.

        Returns:
            A report of the mean pair energy, and as facts: `pairs`, and `similar`, the share of
            pairs above the threshold; and the others by name.
        """
        scalars = {**self._scalars, **more}
        told = torch.stack([value.double() for value in scalars.values()]).tolist()
        found = dict(zip(scalars, told, strict=True))
        energy, pairs, similar = (found.pop(name) for name in ("energy", "inside", "similar"))
        some = max(pairs, 1.0)
        return UncertaintyReport(energy / some, {"pairs": pairs, "similar": similar / some}), found


@dataclass(frozen=True)
class _Taken:
    """Similarities of earlier edges: places [M,2,P], cosines [M,P], and the row of each edge."""

    places: Tensor
    cosines: Tensor
    row: dict[tuple[int, int], int]


class Consistency:
    """The consistency objective over views: keeps what does not change from step to step.

    Args:
        options: of the objective.
        device: of the run.
        name: of the model, for messages.
    Attributes:
        fields: on a CPU the features a second time with the channels last [h,w,c], and their
            lengths [h,w]: bringing a window into that order at every step would cost more than
            the step. With `tolerance` also a serial number of the keyframe, and those of `maps`.
        maps: writes what was learned.
        scale: of similarities, found where the view asks for it; belongs to the state of a model.
    """

    def __init__(self, options: ObjectiveOptions, device: torch.device, name: str) -> None:
        self.options = options
        self._name = name
        self._pairs: _Pairs | None = None
        self._taken: _Taken | None = None
        self._ordered = device.type == "cpu"
        self._kernels: Kernels | None = None
        if self._ordered and options.kernels == "auto":
            self._kernels = load_kernels()
        fields: list[StoreField] = []
        if self._ordered:
            fields += [StoreField(_ROWS, ("h", "w", "c")), StoreField(_LENGTHS, ("h", "w"))]
        if options.tolerance > 0:
            fields.append(StoreField(_SERIAL, (), dtype="int64"))
        self.scale = MatchScale()
        self.maps = Publisher(options)
        self.fields = (*fields, *self.maps.fields)

    def append(self, view: UncertaintyView, index: int) -> None:
        """Prepare the features of a new keyframe.

        Raises:
            ConfigError: there are no features.
        """
        if view.features.shape[1] == 0:
            raise ConfigError(
                f"uncertainty.name: '{self._name}' needs features, but the feature extractor "
                "gives none",
                "choose an extractor, e.g. features=cnn, or switch both off: uncertainty=none",
            )
        self._pairs = None  # `index` may have meant another keyframe until now
        if self._ordered:
            rows = view.features[index].movedim(0, -1).float()
            view.fields[_ROWS][index] = rows
            view.fields[_LENGTHS][index] = rows.norm(dim=2)
        if self.options.tolerance > 0:
            serials = view.fields[_SERIAL]
            number = int(serials.max()) + 1  # its own is 0 yet
            serials[index] = number
            if self._taken is not None:
                row = {k: at for k, at in self._taken.row.items() if max(k) < number}
                self._taken = _Taken(self._taken.places, self._taken.cosines, row)

    def forget(self) -> None:
        """Drop all that was kept from earlier steps."""
        self._pairs = self._taken = None

    def rows(self, view: UncertaintyView, first: int, last: int) -> Tensor:
        """Features of a range of keyframes as float32 rows [n,P,C]; a view on a CPU."""
        if self._ordered:
            return view.fields[_ROWS][first:last].flatten(1, 2)
        return view.features[first:last].flatten(2).transpose(1, 2).float()

    def gradient(self, view: UncertaintyView) -> tuple[Tensor, Numbers]:
        """J [F,h,w] of REFERENCE 4.3 for the F frames of the view, and the facts of the step."""
        options = self.options
        pairs = self._pairs_of(view)
        u = self.maps.learned(view)[pairs.first : pairs.last]
        if self._kernels is not None and options.decoupled:
            pair, energy = self._kernels.pair_gradient(u.flatten(1), pairs.rho, pairs.samples)
        else:
            pair, energy = objective.pair_gradient(
                u.flatten(1), pairs.rho, pairs.samples, options.decoupled
            )
        counts = pairs.counts if options.average else None
        full = objective.frame_gradient(
            pair.view(u.shape), u, counts, options.gamma_data, options.gamma_prior
        )
        numbers = Numbers(energy=energy, inside=pairs.inside, similar=pairs.similar)
        if self.maps.begun:
            full = full * self.maps.believed
        return full[view.frames - pairs.first], numbers

    def share(self, gradient: Tensor) -> float:
        """What the gradient [F,P] of a parameter is multiplied with: a mean, or 1 for the sum."""
        return 1.0 / gradient.numel() if self.options.average else 1.0

    def _pairs_of(self, view: UncertaintyView) -> _Pairs:
        kept, known = self._pairs, view.indices()
        edges = list(zip(known.ii, known.jj, strict=True))
        if (
            kept is not None
            and kept.age + 1 < self.options.refresh
            and kept.edges == edges
            and kept.first <= min(known.frames)
            and kept.last > max(known.frames)
        ):
            kept.age += 1
            return kept
        options = self.options
        pairs = torch.tensor(edges, dtype=torch.int64).view(-1, 2)
        used = objective.edges_used(pairs[:, 0], pairs[:, 1], options.min_gap)
        taken = pairs[used]
        touched = [*taken.flatten().tolist(), *known.frames]
        first, last = min(touched), max(touched) + 1
        device = view.disps.device
        ii, jj = upload(taken[:, 0].contiguous(), device), upload(taken[:, 1].contiguous(), device)
        counts = torch.bincount(taken.flatten() - first, minlength=last - first)
        counts = upload(counts, device)
        self.maps.weigh(view)
        samples = self._samples(view, ii, jj, first)
        if options.tolerance > 0:
            cosine = self._renewed(view, samples, ii, jj, first, last)
        else:
            cosine = self._similarity(view, samples, first, last)
        if view.calibrate:
            measured = matches(view, used, first)
            if measured is not None:
                at, weight = measured
                self.scale.look(self._similarity(view, at, first, last), weight)
            cosine = self.scale(cosine)
        if options.bulk > 0:
            cosine = objective.calibrated(cosine, samples, options.bulk)
        rho = objective.residual(
            cosine, samples, options.similarity_threshold, options.similarity_floor
        )
        inside = samples.inside.sum()
        similar = inside - (rho == 1).sum()
        self._pairs = _Pairs(edges, first, last, counts, samples, rho, inside, similar)
        return self._pairs

    def _samples(
        self, view: UncertaintyView, ii: Tensor, jj: Tensor, first: int
    ) -> objective.Samples:
        poses, disps, intrinsics = view.T_cw, view.disps, view.intrinsics
        if self._kernels is not None:
            return self._kernels.samples(poses, disps, intrinsics, ii, jj, first)
        xy, valid = objective.project(poses, disps, intrinsics, ii, jj)
        return objective.make_samples(xy, valid, disps.shape[2], ii - first, jj - first)

    def _similarity(
        self, view: UncertaintyView, samples: objective.Samples, first: int, last: int
    ) -> Tensor:
        rows = self.rows(view, first, last)
        if not self._ordered:
            return objective.similarity(rows, samples)
        lengths = view.fields[_LENGTHS][first:last].flatten(1)
        if self._kernels is not None:
            return self._kernels.similarity(rows, samples, lengths)
        return objective.similarity(rows, samples, lengths)

    def _renewed(
        self,
        view: UncertaintyView,
        samples: objective.Samples,
        ii: Tensor,
        jj: Tensor,
        first: int,
        last: int,
    ) -> Tensor:
        """Cosines [E,P], taken again only for edges that moved by more than `tolerance`."""
        serials = view.fields[_SERIAL]
        keys = list(zip(serials[ii].tolist(), serials[jj].tolist(), strict=True))
        cosine = samples.place.new_empty(samples.inside.shape)
        places = samples.place.clone()
        moved = torch.ones(len(keys), dtype=torch.bool, device=cosine.device)
        taken = self._taken
        if taken is not None:
            known = [n for n, key in enumerate(keys) if key in taken.row]
            at = on_device([taken.row[keys[n]] for n in known], cosine.device)
            here = on_device(known, cosine.device)
            old = taken.places[at]
            moved[here] = (samples.place[here] - old).abs_().mean((1, 2)) > (
                0.5 * self.options.tolerance
            )
            cosine[here] = taken.cosines[at]
            places[here] = torch.where(moved[here][:, None, None], places[here], old)
        if bool(moved.any()):
            cosine[moved] = self._similarity(view, samples.of(moved), first, last)
        self._taken = _Taken(places, cosine, {key: n for n, key in enumerate(keys)})
        return cosine
