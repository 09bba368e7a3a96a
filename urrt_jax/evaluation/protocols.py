"""Protocols: pure functions from (clouds, item) to a pair with its truth, the same on every machine.

Draws come from NumPy's legacy generator, ``RandomState(item)``, in a fixed order, because that is how the published
protocols are defined. Target = R·source + t, with R = Rx·Ry·Rz. Clouds are in units of the shape's bounding sphere.

A protocol's name may carry options: ``"drift sigma=0.02"`` (``find_protocol``).
"""

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

SIGMA, CLIP = 0.01, 0.05
KEPT = 768


class Trial(NamedTuple):
    """One pair and its truth.

    Attributes:
      source: (N, 3) float32.
      target: (M, 3) float32.
      rotation: (3, 3) float64.
      translation: (3,) float64.
      clean: (P, 3) float32, the whole shape without noise in the target's frame; None where it is not known.
      scale: the length that errors of translation are compared with: 1 for shapes in the unit sphere.
      expected: (3, 3), the rotation in the middle of those that the protocol draws, which methods trained on its poses
        have learned; None for scans, which come in any.
    """

    source: np.ndarray
    target: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    clean: np.ndarray | None = None
    scale: float = 1.0
    expected: np.ndarray | None = None


Protocol = Callable[..., Trial]


def draw_pose(random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """DCP's pose: three angles uniform in [0, 45°], about x, y, z in this order, then a translation in ±0.5."""
    x, y, z = (random.uniform() * np.pi / 4 for _ in range(3))
    translation = np.array([random.uniform(-0.5, 0.5) for _ in range(3)])
    return Rotation.from_euler("zyx", [z, y, x]).as_matrix(), translation


MIDDLE = Rotation.from_euler("zyx", [np.pi / 8] * 3).as_matrix()
"""The rotation in the middle of DCP's: all of them are within 45° of it."""


def draw_noise(random: np.random.RandomState, count: int, sigma: float = SIGMA) -> np.ndarray:
    """Gaussian noise (count, 3), clipped at ±0.05: the drift of points."""
    return np.clip(sigma * random.randn(count, 3), -CLIP, CLIP)


def nearest_rows(points: np.ndarray, place: np.ndarray, count: int) -> np.ndarray:
    """The rows (count,) of the points nearest to a place, nearest first."""
    return np.argsort(np.linalg.norm(points - place, axis=1), kind="stable")[:count]


def dcp(clouds: np.ndarray, item: int, *, points: int = 1024) -> Trial:
    """DCP's clean pair (Wang and Solomon 2019): both clouds hold the same points, each in an order of its own.

    Args:
      clouds: (S, P, 3), shapes in the unit sphere.
      item: which shape; also the seed.
      points: the first so many of its points are used.
    """
    pair, _ = _dcp_pair(clouds, item, points)
    return pair.trial()


def prnet(clouds: np.ndarray, item: int, *, noise: bool = False, kept: int = KEPT, signs: int = 1) -> Trial:
    """PRNet's partial pair (Wang and Solomon 2019): both clouds lose what is far from one common place.

    After DCP's draws, with ``noise`` both clouds drift independently. The place is ``rand(1, 3)`` plus 500 or minus
    500 on all three axes at once, as in the released code, or with ``signs=3`` on each axis by itself, as in some
    published comparisons; each cloud keeps its ``kept`` nearest points, in order of distance. The place is the same in
    both frames, so the crops nearly agree.
    """
    _check_kept(kept, clouds)
    if signs not in (1, 3):
        raise ValueError(f"signs: expected 1, for all three axes, or 3, one for each, got {signs}")
    pair, random = _dcp_pair(clouds, item)
    # The released code adds noise to the float32 source in place and to a float64 target.
    source, target = pair.source.astype(np.float32), pair.target
    if noise:
        # Its clouds are (3, N), and so are its draws.
        source, target = (
            cloud + np.clip(SIGMA * random.randn(3, len(cloud)), -CLIP, CLIP).T for cloud in (source, target)
        )
        source = source.astype(np.float32)
    place = random.random_sample((1, 3)) + 500.0 * random.choice([1, -1, 1, -1], (1, signs))
    source, target = (cloud[nearest_rows(cloud, place, kept)] for cloud in (source, target))
    return pair.trial(source, target)


def rpmnet(clouds: np.ndarray, item: int, *, keep: float = 0.7, points: int = 1024) -> Trial:
    """RPM-Net's cropped and noisy pair (Yew and Lee 2020): two half-spaces, two samples, two noises.

    The generator is seeded again with the item for the crops, for the pose and for the samples, as in the released
    code; noise and order go on from the samples. Each cloud keeps the share ``keep`` on one side of a plane of its own
    and is then sampled to ``keep``·``points``. Needs clouds of more than ``points`` points (2,048).
    """
    if not 0 < keep <= 1:
        raise ValueError(f"keep: expected a share in (0, 1], got {keep}")
    whole, share = np.asarray(clouds[item], np.float32), np.float32(keep)
    if len(whole) <= points:
        raise ValueError(f"rpmnet: needs shapes of more than {points} points (2,048), got {len(whole)}")

    random = np.random.RandomState(item)
    source, target = _half_space(random, whole, share), _half_space(random, whole, share)

    rotation, translation = draw_pose(np.random.RandomState(item))
    source = source @ rotation.T.astype(np.float32)  # the pose of the released code is float32, too
    source = source + translation.astype(np.float32)

    random = np.random.RandomState(item)
    size = math.ceil(share * points)
    source, target = _resample(random, source, size), _resample(random, target, size)
    source, target = (cloud + draw_noise(random, size) for cloud in (source, target))
    target = random.permutation(target)
    source = random.permutation(source)
    # Here the source is the moved cloud: the pair's truth is the way back.
    source, target, back = source.astype(np.float32), target.astype(np.float32), rotation.T
    return Trial(source, target, back, -back @ translation, whole, expected=MIDDLE.T)


def incomplete(clouds: np.ndarray, item: int, *, both: bool = False, kept: int = KEPT) -> Trial:
    """D.I., data incompleteness (3D-URRT's table 2): the source keeps its points nearest to a random place.

    After DCP's draws the place is uniform in [-1, 1]³ of the source's frame. With ``both`` the target loses its points
    far from a place of its own, drawn next, likewise in the source's frame: partial against partial.
    """
    _check_kept(kept, clouds)
    pair, random = _dcp_pair(clouds, item)
    place = random.uniform(-1, 1, 3)
    source, target = pair.source[nearest_rows(pair.source, place, kept)], pair.target
    if both:
        place = pair.rotation @ random.uniform(-1, 1, 3) + pair.translation
        target = target[nearest_rows(target, place, kept)]
    return pair.trial(source, target)


def drift(clouds: np.ndarray, item: int, *, sigma: float = SIGMA, target_only: bool = False) -> Trial:
    """P.D., point drift (3D-URRT's table 2): Gaussian noise on every point, clipped at ±0.05.

    After DCP's draws, of the source and then of the target, independently; with ``target_only`` of the target alone.
    """
    pair, random = _dcp_pair(clouds, item)
    source = pair.source if target_only else pair.source + draw_noise(random, len(pair.source), sigma)
    return pair.trial(source, pair.target + draw_noise(random, len(pair.target), sigma))


def outliers(clouds: np.ndarray, item: int, *, share: float = 0.1, sigma: float = 0.5) -> Trial:
    """D.O., data outliers (3D-URRT's table 2): a share of the points gives way to Gaussian ones.

    After DCP's draws, of the source and then of the target, independently: which rows, then their new places, zero-mean
    in the shape's own frame (so that the target's strays are about the target and not where the source is).
    """
    if not 0 <= share <= 1:
        raise ValueError(f"share: expected a share in [0, 1], got {share}")
    pair, random = _dcp_pair(clouds, item)
    count = round(share * len(pair.source))

    def spoil(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = random.choice(len(cloud), count, replace=False)
        return rows, sigma * random.randn(count, 3)

    source, target = pair.source.copy(), pair.target.copy()
    rows, strays = spoil(source)
    source[rows] = strays
    rows, strays = spoil(target)
    target[rows] = strays @ pair.rotation.T + pair.translation
    return pair.trial(source, target)


def independent(clouds: np.ndarray, item: int, *, noise: float = 0.0, points: int = 1024) -> Trial:
    """Independent sampling, what scanners give: half of the points are the source, the other half the target.

    After DCP's pose, the points are permuted once and split. No point has a counterpart. ``noise`` is the standard
    deviation of the drift of the source and then of the target.
    """
    random = np.random.RandomState(item)
    rotation, translation = draw_pose(random)
    whole = clouds[item, :points].astype(np.float64)
    source, target = np.array_split(random.permutation(whole), 2)
    pair = _Pair(source, target @ rotation.T + translation, rotation, translation, whole)
    if noise == 0:
        return pair.trial()
    source = pair.source + draw_noise(random, len(source), noise)
    return pair.trial(source, pair.target + draw_noise(random, len(target), noise))


def scans(pairs: Sequence[Trial], item: int) -> Trial:
    """A pair of real scans with its measured pose (``urrt_jax.evaluation.load_scan_pairs``)."""
    return pairs[item]


PROTOCOLS: dict[str, Protocol] = {
    "dcp": dcp,
    "prnet": prnet,
    "prnet_noise": functools.partial(prnet, noise=True),
    "rpmnet": rpmnet,
    "incomplete": incomplete,
    "incomplete_both": functools.partial(incomplete, both=True),
    "drift": drift,
    "drift_target": functools.partial(drift, target_only=True),
    "outliers": outliers,
    "independent": independent,
    "independent_noise": functools.partial(independent, noise=SIGMA),
    "scans": scans,
}
"""Every protocol by its name: a new one is a function and a line here."""


def find_protocol(name: str) -> Protocol:
    """The protocol of a name, with the options that follow it: ``"outliers share=0.2"``.

    Raises:
      ValueError: there is no such protocol or option, or an option is not a number.
    """
    word, *options = name.split() or [""]
    if word not in PROTOCOLS:
        raise ValueError(f"protocol: expected one of {', '.join(PROTOCOLS)}, got {name!r}")
    known = [
        key for key, each in inspect.signature(PROTOCOLS[word]).parameters.items() if each.kind == each.KEYWORD_ONLY
    ]
    kinds = inspect.get_annotations(getattr(PROTOCOLS[word], "func", PROTOCOLS[word]))
    values: dict[str, Any] = {}
    for option in options:
        key, _, text = option.partition("=")
        if key not in known:
            raise ValueError(f"protocol: {word!r} has the options {', '.join(known) or 'none'}, got {option!r}")
        try:
            values[key] = float(text) if kinds[key] is float else int(text)
        except ValueError:
            kind = "a number" if kinds[key] is float else "a whole number"
            raise ValueError(f"protocol: {key} expects {kind}, got {option!r}") from None
    return functools.partial(PROTOCOLS[word], **values) if values else PROTOCOLS[word]


class _Pair(NamedTuple):
    """A pair in float64, before it is spoiled, and the whole shape in the source's frame."""

    source: np.ndarray
    target: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    whole: np.ndarray

    def trial(self, source: np.ndarray | None = None, target: np.ndarray | None = None) -> Trial:
        """The trial with these clouds in the place of the pair's own."""
        source, target = (self.source if source is None else source), (self.target if target is None else target)
        clean = self.whole @ self.rotation.T + self.translation
        return Trial(
            source.astype(np.float32), target.astype(np.float32), self.rotation, self.translation,
            clean.astype(np.float32), expected=MIDDLE,
        )  # fmt: skip


def _dcp_pair(clouds: np.ndarray, item: int, points: int = 1024) -> tuple[_Pair, np.random.RandomState]:
    """DCP's pair of the first ``points`` points, and the generator after its draws."""
    random = np.random.RandomState(item)
    rotation, translation = draw_pose(random)
    whole = clouds[item, :points].astype(np.float64)
    target = whole @ rotation.T + translation
    source, target = random.permutation(whole), random.permutation(target)
    return _Pair(source, target, rotation, translation, whole), random


def _check_kept(kept: int, clouds: np.ndarray) -> None:
    if not 3 <= kept <= clouds.shape[1]:
        raise ValueError(f"kept: expected 3 to {clouds.shape[1]} points, those of a shape, got {kept}")


def _half_space(random: np.random.RandomState, points: np.ndarray, share: np.float32) -> np.ndarray:
    """The share of the points (N, 3) on one side of a plane, whose normal is uniform on the sphere."""
    azimuth = random.uniform(0.0, 2 * np.pi)
    inclination = np.arccos(random.uniform(-1.0, 1.0))
    ring = np.sin(inclination)
    normal = np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), np.cos(inclination)])
    height = (points - points.mean(axis=0)) @ normal
    return points[height > np.percentile(height, (1.0 - share) * 100)]


def _resample(random: np.random.RandomState, points: np.ndarray, count: int) -> np.ndarray:
    """``count`` of the points without repetition; where they are fewer, all of them and repeated ones."""
    if count <= len(points):
        return points[random.choice(len(points), count, replace=False)]
    every = random.choice(len(points), len(points), replace=False)
    return points[np.concatenate([every, random.choice(len(points), count - len(points), replace=True)])]
