"""The suites catch what they promise to catch, and the sentence names part and clause."""

import dataclasses
import random
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch

from droidw.errors import InputError, UsageError
from droidw.interfaces.correspondence import EdgeUpdate
from droidw.interfaces.depth import DepthMap
from droidw.interfaces.uncertainty import StoreField, UncertaintyReport
from droidw.plugin.component import Component
from droidw.solve.problem import Report, Step
from droidw.testing import conformance
from droidw.testing.scenes import Scene, named_spec
from droidw_plugins.bundle.torch_ba import COMPONENT as TORCH_BA
from droidw_plugins.correspondence.synthetic import COMPONENT as SYNTHETIC
from droidw_plugins.datasets.synthetic import COMPONENT as READER


def component(part, **changes):
    """A component whose factory makes `part()`."""
    given = {
        "name": "made-up",
        "summary": "a part of this test",
        "factory": lambda options, context: part(),
        **changes,
    }
    return Component(**given)


def broken(clause, kind, made, **more):
    with pytest.raises(AssertionError, match=f"'{made.name}' breaks clause '{clause}'") as caught:
        conformance.check(kind, made, **more)
    return str(caught.value)


class Mean:
    """A right extractor: mean colour around each cell."""

    dim = 3

    def extract(self, image, grid):
        return grid.sample(image)


FEATURES = frozenset({"cpu", "features"})


def extractor(change):
    class Changed(Mean):
        def extract(self, image, grid):
            return change(super().extract(image, grid), image, grid)

    return component(Changed, capabilities=FEATURES)


def draw_at_random(features, image, grid):
    return features + torch.rand(())


def mutate(features, image, grid):
    image.mul_(0.5)
    return features


def raise_for_odd(features, image, grid):
    if image.shape[-1] % 2:
        raise RuntimeError("odd")
    return features


def test_a_right_extractor_passes():
    conformance.check_feature_extractor(component(Mean, capabilities=FEATURES))


@pytest.mark.parametrize(
    ("clause", "change"),
    [
        ("shape", lambda f, image, grid: f[:2]),
        ("shape", lambda f, image, grid: f.transpose(1, 2)),
        ("dtype", lambda f, image, grid: f.double()),
        ("finite", lambda f, image, grid: f / (image.amax() > 0)),
        ("no-grad", lambda f, image, grid: f.clone().requires_grad_()),
        ("no-mutation", mutate),
        ("deterministic", draw_at_random),
        ("errors", raise_for_odd),
    ],
)
def test_extractor_faults_are_caught(clause, change):
    broken(clause, "features", extractor(change))


def test_capability_must_fit_dim():
    broken("capability", "features", component(Mean))


def test_factory_must_not_touch_global_generators():
    def seeding(options, context):
        random.seed(context.seed)
        return Mean()

    broken("own-generator", "features", component(Mean, factory=seeding, capabilities=FEATURES))


def test_missing_method_is_caught():
    class Half:
        dim = 3

    assert "FeatureExtractor" in broken(
        "protocol", "features", component(Half, capabilities=FEATURES)
    )


@dataclass(frozen=True)
class Helpless:
    scale: float = 1.0


@dataclass(frozen=True)
class Required:
    scale: float = field(metadata={"help": "a factor"})


@pytest.mark.parametrize(
    ("clause", "changes"),
    [
        ("name", {"name": "Made_Up"}),
        ("summary", {"summary": "two\nlines"}),
        ("summary", {"summary": ""}),
        ("capabilities", {"capabilities": frozenset({"features"})}),
        ("options", {"options": Helpless}),
        ("options", {"options": Required}),
        ("options", {"options": dict}),
        ("extra", {"extra": "net"}),
    ],
)
def test_record_faults_are_caught_before_anything_is_built(clause, changes):
    def factory(options, context):
        raise AssertionError("the factory was called")

    broken(clause, "features", component(Mean, factory=factory, **changes))


def test_heavy_import_is_caught(tmp_path, monkeypatch):
    (tmp_path / "heavy_plugin.py").write_text("import cv2\ndef build(options, context): ...\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    import heavy_plugin

    made = component(Mean, factory=heavy_plugin.build)
    with pytest.raises(AssertionError, match="heavy_plugin imports cv2 at its top"):
        conformance.check_component("features", made)


class Flat:
    metric = True

    def predict(self, frame):
        return DepthMap(torch.ones(frame.image.shape[-2:]))


def test_depth_prior_faults_are_caught():
    class Negative(Flat):
        def predict(self, frame):
            return DepthMap(super().predict(frame).depth - 2)

    class Small(Flat):
        def predict(self, frame):
            return DepthMap(super().predict(frame).depth[::2])

    depth = frozenset({"cpu", "depth"})
    conformance.check_depth_prior(component(Flat, capabilities=depth))
    broken("capability", "depth", component(Flat))
    broken("range", "depth", component(Negative, capabilities=depth))
    broken("shape", "depth", component(Small, capabilities=depth))


class Constant:
    fields = ()

    def append(self, view, index):
        view.uncertainty[index] = 0.5

    def update(self, view):
        view.uncertainty[view.frames] = 0.6
        return UncertaintyReport(1.0)

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def test_uncertainty_faults_are_caught():
    class Negative(Constant):
        def append(self, view, index):
            view.uncertainty[index] = -0.5

    class Everywhere(Constant):
        def update(self, view):
            view.uncertainty.fill_(0.7)
            return UncertaintyReport()

    class Dividing(Constant):
        def update(self, view):
            view.uncertainty[view.frames] = view.confidence.mean() / view.confidence.sum()
            return UncertaintyReport()

    class Spoiling(Constant):
        def update(self, view):
            view.target.zero_()
            return UncertaintyReport()

    class Forgetful(Constant):
        def __init__(self):
            self.count = 0

        def update(self, view):
            self.count += 1
            view.uncertainty[view.frames] = float(self.count)
            return UncertaintyReport()

    class Numbering(Constant):
        """Keeps what it made of a keyframe by its number, though another one may have that now."""

        def __init__(self):
            self.kept = {}

        def append(self, view, index):
            view.uncertainty[index] = 1.0
            self.kept.setdefault(index, float(view.features[index].float().abs().sum()))

        def update(self, view):
            for k in view.frames.tolist():
                found = float(view.features[k].float().abs().sum())
                view.uncertainty[k] = self.kept.get(k, found)
            return UncertaintyReport()

    class Doubled(Constant):
        fields = (StoreField("a", ("h", "w")), StoreField("a", ("c",)))

    class Taken(Constant):
        fields = (StoreField("prior", ("h", "w")),)

    conformance.check_uncertainty_model(component(Constant))
    for clause, part in (
        ("range", Negative),
        ("only-asked", Everywhere),
        ("finite", Dividing),
        ("no-mutation", Spoiling),
        ("state", Forgetful),
        ("between", Numbering),
        ("fields", Doubled),
        ("fields", Taken),
    ):
        broken(clause, "uncertainty", component(part))


def solver(change):
    """The torch backend with its step changed by `change(problem, step, part)`."""

    class Changed:
        def __init__(self):
            self.part = TORCH_BA.factory(TORCH_BA.options(), None)

        def step(self, problem):
            return change(problem, self.part.step(problem), self.part)

    return component(Changed)


def test_bundle_faults_are_caught():
    def frozen(problem, step, part):
        if step.report.status != "ok":
            return step
        disps = problem.disps.clamp(problem.min_disp, problem.max_disp)
        return Step(problem.T_cw.clone(), disps, Report("ok", 1.0, 0.5, dropped=1))

    def moves_fixed(problem, step, part):
        return dataclasses.replace(step, T_cw=step.T_cw + 0.001)

    def in_place(problem, step, part):
        problem.disps.mul_(0.9)
        return step

    def shares(problem, step, part):
        return Step(problem.T_cw, problem.disps, step.report)

    def moves_depth(problem, step, part):
        return dataclasses.replace(step, disps=step.disps * 1.01)

    def poisoned(problem, step, part):
        if problem.target.isfinite().all():
            return step
        return Step(problem.T_cw * float("nan"), problem.disps.clone(), Report("ok", 1.0))

    def two_channels(problem, step, part):
        return part.step(dataclasses.replace(problem, weight=problem.weight[..., :2]))

    for clause, change in (
        ("converges", frozen),
        ("unit|fixed", moves_fixed),
        ("no-mutation", in_place),
        ("fresh", shares),
        ("motion-only", moves_depth),
        ("finite", poisoned),
        ("information", two_channels),
    ):
        made = solver(change)
        with pytest.raises(AssertionError, match=f"breaks clause '({clause})'"):
            conformance.check_ba_backend(made)


class Wrapped:
    """Correspondence `synthetic` with a session that may be changed."""

    def __init__(self, change):
        self.inner = SYNTHETIC.factory(SYNTHETIC.options(), type("Context", (), {"seed": 0}))
        self.change = change
        self.stride, self.offset = self.inner.stride, self.inner.offset
        self.encode, self.context = self.inner.encode, self.inner.context
        self.motion = self.inner.motion

    def session(self, purpose="window"):
        return WrappedSession(self.inner.session(purpose), self.change)


class WrappedSession:
    def __init__(self, inner, change):
        self.inner, self.change = inner, change

    def update(self, request):
        return self.change(request, self.inner.update(request))

    def forget(self, ids):
        if self.change is not deaf:
            self.inner.forget(ids)


def deaf(request, update):
    return update


def tilted(confidence, share):
    off = share * confidence.prod(-1, keepdim=True).sqrt()
    return torch.cat([confidence, off], dim=-1)


def reversed_answers(request, update):
    order = torch.tensor(np.argsort(request.ids), dtype=torch.long)
    return EdgeUpdate(update.target[order], update.confidence[order])


@pytest.mark.parametrize(
    ("clause", "change"),
    [
        ("shape", lambda r, u: EdgeUpdate(u.target[..., 0], u.confidence)),
        ("range", lambda r, u: EdgeUpdate(u.target, u.confidence - 1)),
        ("range", lambda r, u: EdgeUpdate(u.target, tilted(u.confidence, 1.1))),
        ("accuracy", lambda r, u: EdgeUpdate(u.target + 3, u.confidence)),
        ("order", reversed_answers),
        ("forget", deaf),
    ],
)
def test_correspondence_faults_are_caught(clause, change):
    broken(clause, "correspondence", component(lambda: Wrapped(change)))


class Choosy(Wrapped):
    """Refuses pictures of which a side is no multiple of `multiple`, as a network may."""

    multiple = 8

    def __init__(self):
        super().__init__(lambda request, update: update)
        del self.encode

    def encode(self, frame, grid):
        if any(side % self.multiple for side in frame.image.shape[-2:]):
            raise InputError("pictures of this size do not suit")
        return self.inner.encode(frame, grid)


class TooChoosy(Choosy):
    multiple = 7


def test_correspondence_may_refuse_odd_sizes_but_not_all():
    conformance.check("correspondence", component(Choosy))
    broken("errors", "correspondence", component(TooChoosy))


class Marked(Wrapped):
    """Matches one point between all pictures."""

    def __init__(self, points):
        super().__init__(lambda request, update: update)
        self.points = np.array(points, np.float32)

    def matched_points(self, a, b, gate_a, gate_b):
        return self.points[: int(min(gate_a.min(), gate_b.min()))]


def test_points_lie_in_the_pictures_and_not_where_these_are_closed():
    conformance.check("correspondence", component(lambda: Marked([[5, 6, 7, 8]])))
    broken("matched_points", "correspondence", component(lambda: Marked([[5, 6, 999, 8]])))
    broken("matched_points", "correspondence", component(lambda: Marked([[5, 6]])))
    seen = type("Seen", (Marked,), {"matched_points": lambda self, a, b, _, __: self.points})
    broken("matched_points", "correspondence", component(lambda: seen([[5, 6, 7, 8]])))


class Lined(Wrapped):
    """Finds the same lines in every picture, or others every time."""

    def __init__(self, lines, drift=0.0):
        super().__init__(lambda request, update: update)
        self.lines, self.drift = np.array(lines, np.float32), drift

    def line_segments(self, payload):
        self.lines = self.lines + self.drift
        return self.lines


def test_lines_lie_in_the_picture_and_stay():
    conformance.check("correspondence", component(lambda: Lined([[5, 6, 17, 18]])))
    conformance.check("correspondence", component(lambda: Lined(np.zeros((0, 4)))))
    broken("line_segments", "correspondence", component(lambda: Lined([[5, 6, 999, 8]])))
    broken("line_segments", "correspondence", component(lambda: Lined([[5, 6]])))
    broken("line_segments", "correspondence", component(lambda: Lined([[5, 6, 17, 18]], 0.5)))


SMALL = READER.options(frames=6, width=64, height=48)
SHARED = Scene(named_spec("handheld", frames=6, width=64, height=48))


class Footage:
    """Reader `synthetic`, whose frames may be changed."""

    change = staticmethod(lambda frames: frames)

    def __init__(self):
        self.inner = READER.factory(SMALL, None)

    def recognises(self, source):
        return self.inner.recognises(source)

    def open(self, source, selection):
        opened = self.inner.open(source, selection)
        opened.scene = SHARED  # its textures are painted once for all tests
        frames = opened.frames
        opened.frames = lambda: iter(self.change(list(frames())))
        return opened


def reader(change):
    return component(type("Changed", (Footage,), {"change": staticmethod(change)}))


def test_reader_faults_are_caught():
    conformance.check_dataset_reader(component(Footage), "synthetic")
    replace = dataclasses.replace
    faults = {
        "time": lambda fs: [replace(f, time=1.0) for f in fs],
        "dtype": lambda fs: [replace(f, image=f.image / 255.0) for f in fs],
        "shape": lambda fs: [replace(f, image=f.image[: 40 + f.index]) for f in fs],
        "index": lambda fs: [replace(f, index=0) for f in fs],
        "length": lambda fs: fs[:-1],
        "repeatable": lambda fs: [
            replace(f, image=f.image ^ np.uint8(random.randrange(255))) for f in fs
        ],
    }
    for clause, change in faults.items():
        broken(clause, "reader", reader(change), source="synthetic")

    class Greedy(Footage):
        def recognises(self, source):
            return True

    class Crashing(Footage):
        def open(self, source, selection):
            if not self.recognises(source):
                raise FileNotFoundError(source)
            return super().open(source, selection)

    broken("recognises", "reader", component(Greedy), source="synthetic")
    assert "FileNotFoundError" in broken(
        "errors", "reader", component(Crashing), source="synthetic"
    )
    with pytest.raises(UsageError, match="footage"):
        conformance.check("reader", READER)


class Lines:
    def export(self, result, folder):
        path = Path(folder) / "times.txt"
        path.write_text("\n".join(map(str, result.trajectory.times)))
        return [path]


def test_exporter_faults_are_caught():
    class Outside(Lines):
        def export(self, result, folder):
            (folder.parent / "stray.txt").write_text("x")
            return super().export(result, folder)

    class Silent(Lines):
        def export(self, result, folder):
            super().export(result, folder)
            return []

    class Fragile(Lines):
        def export(self, result, folder):
            return super().export(result, folder) if result.keyframes[0] else []

    class Shifting(Lines):
        def export(self, result, folder):
            result.trajectory.T_wc[:, 0] += 1
            return super().export(result, folder)

    conformance.check_exporter(component(Lines))
    for clause, part in (
        ("folder", Outside),
        ("files", Silent),
        ("errors", Fragile),
        ("no-mutation", Shifting),
    ):
        broken(clause, "exporter", component(part))


def test_observer_faults_are_caught():
    class Fine:
        def on_event(self, event):
            pass

    class Strict:
        def on_event(self, event):
            {"RunStarted": 1}[type(event).__name__]

    class Loud:
        def on_event(self, event):
            return True

    conformance.check_observer(component(Fine))
    broken("errors", "observer", component(Strict))
    broken("silent", "observer", component(Loud))


def test_unknown_kind_is_refused():
    with pytest.raises(UsageError, match="features, depth"):
        conformance.check("feature", component(Mean))
