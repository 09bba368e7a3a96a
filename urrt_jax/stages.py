"""The stages of a registration, compiled one by one, and the ladder of sizes that they are compiled for.

A registration takes these steps. Each one after the first is a *stage*: a program of its own (``programs``).

1. **Normalise** (``frames``, before the stages). Both clouds are centred, and divided by one common scale, their root
   mean square radius. The result is carried back into the clouds' own units at the end.
2. **Prepare** (``prepare``). Each cloud is sorted along a space-filling curve; its spacing and normals are measured,
   and of small clouds the constellations, by which points of both clouds are known again.
   Farthest-point sampling chooses 512 points, the same ones however the cloud is turned, moved, scaled or ordered.
   Clouds of more than 4,096 points are first thinned along the curve, and that does depend on how they are turned.
3. **Recognise** (``recognise``). Where small clouds hold the same points, constellations of these tell the pose. It is
   *known* then, and what would look for it is passed over.
4. **Estimate** (``estimate``). The network (``urrt_jax.model``) estimates the transform from the samples. The user's
   initial transform takes its place where it fits better.
5. **Approach** (``approach``). Robust point-to-point ICP on the samples gives the *plain pose*. It calls for a search
   where the samples do not fit in it, or not well enough for how far it turns.
6. **Search** (rare; ``search_thoroughly``). Matched FPFH features and the network's landmarks propose hypotheses. The
   best are refined, and the best of these is kept. Dense clouds get a quick look first (``search_quickly``), whose
   pose is refined, large clouds being thinned, and assessed among the whole clouds (``judge_quick_look``). Where that
   does not settle it, three finalists of the thorough search are refined and assessed alike, and the one in which the
   whole clouds then fit best is kept (``choose_finalist``). Nothing is random.
7. **Refine** (``settle``; large clouds first in ``settle_thinned``). Robust ICP with correspondences in both
   directions, among the full clouds, mostly point to plane. The bandwidth of its weights shrinks to the spacing, and
   then to the spread of the distances themselves, so that points without a counterpart do not pull. Small clouds whose
   points have no counterparts at all are refined by EM-ICP (``expect``; rare).
8. **Compare** (``compare``). Other poses that fit about as well: the source is turned about the centre of both clouds,
   and the turns that fit best are refined and compared with the pose.
9. **Assess** (``assess``). Inliers, overlap, the information matrix, the covariance, and the confidence.
10. **Label** (``label``). The region of every point.

``register_in_frame`` calls the stages. On arrays it reads from each result whether a rare stage is needed, and runs
(and compiles) it only then. Under a trace the same stages are composed, and rare ones become loops that only run for
pairs which need them.

Network, search, the coarse stage of refinement and ``compare`` see samples of fixed size: they are compiled once,
whatever the clouds. ``prepare``, ``settle``, ``assess`` and ``label`` see whole clouds and are compiled for each rung
of the ladder, as are the rare ``settle_thinned`` and ``expect`` where a pair needs them.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from urrt_jax import prepared, refine, rigid, search
from urrt_jax.assessment import (
    Alternatives,
    agreement,
    confidence,
    find_alternatives,
    fit,
    fit_samples,
    information,
    inlier_share,
    measure,
    odds,
    precision,
    well_posed,
)
from urrt_jax.clouds import Cloud, first, mean_square_radius
from urrt_jax.features import Constellations
from urrt_jax.loops import anyone, where_needed
from urrt_jax.model.network import Model, point_regions
from urrt_jax.model.network import estimate as apply_network
from urrt_jax.prepared import THINNED, Prepared, Samples, Sizes
from urrt_jax.programs import Program
from urrt_jax.refine import ICP, find_basin
from urrt_jax.result import OtherPoses, Outcome
from urrt_jax.rigid import Known, Rigid
from urrt_jax.search import Found, Search

STEPS_BEFORE_REFINEMENT = 2
"""Steps of the network, at most, where refinement follows, which does the rest."""
_SMALLEST_RUNG, _FACTOR = 256, 4
_SAMPLE = 512  # points of the even subsample, at least
# What the plain pose is worth on the subsample (``Fit.score`` less what its turn costs), below which a search is called
# for. Dense clouds are searched more readily, because their quick look is cheap. Chosen on training shapes; for dense
# clouds, on bunny pairs and views of made-up solids.
_FITS, _FITS_DENSE = 0.78, 0.92
_COARSE_GRID, _LOST_GRID = 0.1, 1.0
"""The step between float32 coordinates, in spacings, from which on lost digits explain a failure, and from which on no
result is trusted: then neighbouring points have fallen together. Guesses."""
_FEWEST = 3  # correspondences; fewer say nothing of the covariance
_UNKNOWN = (1.0,) * 3 + (np.pi**2,) * 3  # the covariance of what is not known, in squared radii and radians
_SEARCHED_AT_ONCE = 2  # pairs of a batch


def rung(count: int) -> int:
    """The number of rows to which clouds of ``count`` points are padded: 256, 1,024, 4,096 and so on, times four."""
    size = _SMALLEST_RUNG
    while size < count:
        size *= _FACTOR
    return size


class Seen(NamedTuple):
    """A cloud as the network saw it last.

    Attributes:
      moved: the transform that the cloud had undergone.
      cloud: the points that it saw, at most ``ModelConfig.points``.
      labels: (N,) int32, their regions.
    """

    moved: Rigid
    cloud: Cloud
    labels: Array


class Start(NamedTuple):
    """Where registration begins.

    Attributes:
      transform: the network's estimate, or the user's initial transform where that fits better.
      coarse: the network's estimate, or the pose that was known.
      source: what the network saw of the source.
      target: what it saw of the target.
    """

    transform: Rigid
    coarse: Rigid
    source: Seen
    target: Seen


class Plan(NamedTuple):
    """The plain pose and the rare stages that it calls for.

    Attributes:
      found: the plain pose; ``pending`` where it calls for a search.
      quick: (), bool, whether the search begins with a quick look.
      thin_first: (), bool, whether refinement begins among thinned clouds.
    """

    found: Found
    quick: Array
    thin_first: Array


class Report(NamedTuple):
    """What is said of a registration, in the pair's frame: the fields of ``Registration`` with these names."""

    fitness: Array
    rmse: Array
    inlier_distance: Array
    overlap: Array
    confidence: Array
    converged: Array
    outcome: Array
    correspondences: Array
    information: Array
    covariance: Array
    alternatives: OtherPoses


class Assessment(NamedTuple):
    """What is found out about a transform.

    Attributes:
      report: what is said of it.
      score: (), in [0, 1]: how well the whole clouds lie on each other (``Fit.score``).
    """

    report: Report
    score: Array


class Options(NamedTuple):
    """What the user chose.

    Attributes:
      model: the network.
      refine: how to refine; None to leave that out.
      search: how to search; None to leave that out.
      always: whether to search also where the plain pose is sure.
    """

    model: Model
    refine: ICP | None
    search: Search | None
    always: bool | Array


class Told(NamedTuple):
    """What is known of a pair besides its clouds, all in the pair's frame.

    Attributes:
      has_initial: (), bool, whether there is an initial transform. The source has been moved by it.
      offset: (3,), all that is left of it in the frame: a translation, because each cloud was centred.
      initial_is_finite: (), bool; True where there is none.
      inlier_distance: (), 0 for the default.
      grid: (), the step between the coordinates that float32 could hold.
    """

    has_initial: Any
    offset: Any
    initial_is_finite: Any
    inlier_distance: Any
    grid: Any


class Outputs(NamedTuple):
    """A registration in the pair's frame."""

    transform: Rigid
    coarse: Rigid
    report: Report
    source_regions: Array
    target_regions: Array
    steps: Any


@Program
def recognise(_: None, source: Constellations, target: Constellations) -> Known:
    """The pose of clouds that hold the same points. The first argument is shared by a batch; here it is nothing."""
    return search.find_counterparts(source, target)


@Program
def estimate(model: Model, source: Samples, target: Samples, known: Known, told: Told) -> Start:
    """Where registration begins, from even samples of both clouds."""
    nothing = rigid.identity()
    clouds = first(source.even, model.config.points), first(target.even, model.config.points)

    answer = apply_network(model, *clouds, known)
    coarse = answer.transform
    given = Rigid(nothing.rotation, told.offset)
    poses = jax.tree.map(lambda *leaves: jax.lax.stop_gradient(jnp.stack(leaves)), coarse, given)
    even = source.even, target.even
    scores = jax.lax.cond(
        jnp.asarray(told.has_initial),
        lambda: agreement(poses, even, even, prepared.coarser(source, target)),
        lambda: jnp.zeros(2, poses.translation.dtype),
    )
    return Start(
        transform=rigid.choose(~known.sure & (scores[0] < scores[1]), given, coarse),
        coarse=coarse,
        source=Seen(answer.seen, answer.source.cloud, answer.source.regions.labels),
        target=Seen(nothing, answer.target.cloud, answer.target.regions.labels),
    )


@Program
def approach(
    options: tuple[ICP, Array | bool, Array | float],
    source: Samples,
    target: Samples,
    counts: tuple[Array, Array],
    known: Known,
    start: Rigid,
) -> Plan:
    """The plain pose, refined on even samples, and what it calls for.

    A search, where the samples do not fit, or do not fit well enough for how far it turns: what a turn costs in the
    search (the preference, the last of the options) counts here, too. On nearly symmetric shapes such a pose is often
    the wrong way around.

    Where the pose is known there is nothing to refine here or to search for: on a plane, whose samples slide, other
    poses may well fit better.
    """
    how, always, preference = options
    kept = known.transform, jnp.zeros_like(known.transform.translation[0])
    basin = jax.lax.cond(anyone(~known.sure), lambda: find_basin(how, source, target, start), lambda: kept)
    transform, width = rigid.choose(known.sure, kept[0], basin[0]), jnp.where(known.sure, kept[1], basin[1])
    glance = fit_samples(source.even, target.even, transform, prepared.coarser(source, target))
    fewer = jnp.minimum(*counts)
    dense = fewer >= search.DENSE
    turn = rigid.rotation_angle(transform.rotation, jnp.eye(3)) / np.pi
    worth = glance.score - search.cost(search.preference_among(preference, dense), turn)
    pending = ~known.sure & (always | (worth < jnp.where(dense, _FITS_DENSE, _FITS)))
    finalists = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (search.FINALISTS, *leaf.shape)), transform)
    found = Found(transform, jnp.zeros_like(width), width, pending, finalists)
    return Plan(found, pending & dense, fewer > THINNED)


@Program
def compare(_: None, source: Samples, target: Samples, transform: Rigid) -> Alternatives:
    """Other poses that fit about as well. The first argument is shared by the pairs of a batch; here it is nothing."""
    return find_alternatives(source, target, transform)


@Program
def assess(
    refined: bool | Array,
    source: Prepared,
    target: Prepared,
    transform: Rigid,
    settled: Array,
    others: Alternatives,
    told: Told,
) -> Assessment:
    """What is found out about a transform."""
    found = fit(source, target, transform, told.inlier_distance)
    # Derivatives pass through the distances of these neighbours, which are as they are.
    moved, nearest = rigid.apply(transform, source.cloud.points), target.cloud.points[found.nearest]
    squared = jnp.where(jnp.isfinite(found.squared), jnp.sum((moved - nearest) ** 2, axis=-1), jnp.inf)
    asked = jnp.asarray(told.inlier_distance, squared.dtype)
    reach = jnp.where(asked > 0, asked, found.touching)
    fitness, rmse = inlier_share(source.cloud.mask, squared, reach)
    inlier = source.cloud.mask & (squared <= reach**2)
    rows = jnp.where(inlier, target.rows[found.nearest], -1)
    determined = well_posed(source.cloud) & well_posed(target.cloud) & jnp.all(jnp.isfinite(transform.translation))
    precise = precision(source, target, transform)
    measured = measure(found, others, precise)
    checks = confidence(measured)
    usable = determined & told.initial_is_finite & jnp.all(jnp.isfinite(measured))
    spacing = prepared.coarser(source, target)
    # A cloud that is smaller than the other's spacing is a point to it, and fits in any rotation.
    smaller = jnp.minimum(*(mean_square_radius(each.cloud) for each in (source, target)))
    checks = checks._replace(determined=jnp.where(smaller > spacing**2, checks.determined, 0.0))
    total = jnp.where(usable, checks.total, 0.0)
    sure, least = total >= 0.5, jnp.argmin(jnp.stack(checks))
    lost = jnp.where(sure & settled, _LOST_GRID, _COARSE_GRID) * spacing
    # In order of precedence; the first that holds is the outcome.
    outcomes = {
        Outcome.INITIAL: ~jnp.asarray(told.initial_is_finite),
        Outcome.DEGENERATE: ~determined,
        Outcome.DIGITS: told.grid > lost,
        Outcome.UNSETTLED: jnp.asarray(refined) & ~settled,
        Outcome.CONVERGED: sure,
        Outcome.MISFIT: (checks.surfaces < 0.5) | (least == checks._fields.index("surfaces")),
        Outcome.AMBIGUOUS: least == checks._fields.index("unique"),
        Outcome.UNDETERMINED: jnp.array(True),
    }
    outcome = jnp.select(list(outcomes.values()), [jnp.int32(each) for each in outcomes])
    against = jnp.where(usable, odds(others), 0.0)
    unknown = jnp.diag(jnp.array(_UNKNOWN, precise.covariance.dtype))
    report = Report(
        fitness=fitness,
        rmse=rmse,
        inlier_distance=reach,
        overlap=found.overlap,
        confidence=total,
        converged=outcome == Outcome.CONVERGED,
        outcome=outcome,
        correspondences=jnp.zeros_like(rows).at[source.rows].set(rows),
        information=information(nearest, inlier),
        covariance=jnp.where(usable & (precise.pairs > _FEWEST), precise.covariance, unknown),
        alternatives=OtherPoses(*others.poses, against / (1 + jnp.sum(against))),
    )
    return Assessment(report, found.score)


@Program
def label(_: None, cloud: Prepared, seen: Seen) -> Array:
    """The region of every point (N,), in the order in which the cloud was given; 0 for padding.

    The first argument is shared by the clouds of a batch; here it is nothing.
    """
    moved = rigid.apply(seen.moved, cloud.cloud.points)
    labels = point_regions(moved, seen.cloud, seen.labels, count=cloud.count)
    return jnp.zeros_like(labels).at[cloud.rows].set(jnp.where(cloud.cloud.mask, labels, 0))


prepare = Program(prepared.prepare)
search_quickly = Program(search.search_quickly)
judge_quick_look = Program(search.judge_quick_look)
search_thoroughly = Program(search.search_thoroughly)
choose_finalist = Program(search.choose_finalist)
settle_thinned = Program(refine.settle_thinned)
settle = Program(refine.settle)
expect = Program(refine.expect)


def register_in_frame(
    options: Options, source: Cloud, target: Cloud, told: Told, *, batch: int | None = None, rare: bool = False
) -> Outputs:
    """The registration of two clouds in their frame, padded to one size.

    Args:
      options: what the user chose.
      source: N rows.
      target: N rows.
      told: what else is known of the pair.
      batch: on arrays and abstract values: how many pairs there are, where clouds and ``told`` have a leading axis. It
        may be longer: more rows fill a batch up to the size that is compiled, and no rare stage is run for them.
      rare: on abstract values: whether rare stages are compiled, too.
    """
    model, how, searching, always = options
    mode = _mode(options, source, target, told)

    def call(program: Program, *arguments: Any) -> Any:
        return (program if batch is None else program.batched)(*arguments)

    size = source.mask.shape[-1]

    def wanted(flag: Any, *, least: int = 0, most: int | None = None, often: bool = False) -> bool:
        """Whether to call a stage that some pairs need, of ``least`` points to ``most``.

        ``often`` says that nearly all of these need it: it is compiled ahead although ``rare`` is False.
        """
        if mode == "concrete":
            return bool(np.any(flag))
        if mode == "traced":  # a pair of more rows than ``most`` may have fewer points
            return size >= least
        return size >= least and (most is None or size <= rung(most)) and (rare or often)

    def when(needed: Any, program: Callable, arguments: tuple, otherwise: Any, *, least: int = 0) -> Any:
        """The program's answer for the pairs that need it."""
        if not wanted(needed, least=least):
            return otherwise
        if mode == "traced":
            # As a list: JAX puts flags in place of leaves, which the checks of Search would refuse.
            leaves, tree = jax.tree.flatten(arguments)
            inner = lambda leaves: program(*jax.tree.unflatten(tree, leaves))  # noqa: E731
            return where_needed(needed, inner, leaves, otherwise, at_once=_SEARCHED_AT_ONCE)
        if batch is None:
            return program(*arguments)
        return _one_by_one(np.asarray(needed)[:batch], program, arguments, otherwise)

    refiner = ICP() if how is None else how
    sizes = sizes_of(options)
    clouds = call(prepare, sizes, source), call(prepare, sizes, target)
    samples = clouds[0].samples, clouds[1].samples
    refined = how is not None or searching is not None
    known = call(recognise, None, *(each.constellations for each in samples)) if refined else _not_known(source)
    start = call(estimate, model, *samples, known, told)
    # Where there is no refinement, all that can be unsettled is an initial transform that is not finite.
    pose, settled, steps = start.transform, told.initial_is_finite, np.int32(0)
    if refined:
        counts = clouds[0].count, clouds[1].count
        preference = 0.0 if searching is None else searching.preference
        asked = refiner, always, preference
        found, quick, thin_first = call(approach, asked, *samples, counts, known, start.transform)
        if searching is not None:
            asked = (refiner, searching), *clouds, found, told
            found = when(quick, _look_quickly, asked, found, least=search.DENSE)
            found = when(found.pending, search_thoroughly, ((searching, model), *samples, found), found)
            if how is not None:
                asked = (how, searching), *clouds, found, told
                found = when(found.pending, _verified, asked, found, least=search.DENSE)
            pose = found.transform
    if how is not None:
        pose, width = found.transform, found.width
        if wanted(thin_first, least=THINNED + 1, often=True):
            pose, width = call(settle_thinned, how, *clouds, pose, width)
        end = last = call(settle, how, *clouds, pose, width)
        if wanted(end.sparse, most=how.em_points):
            last = call(expect, how, *clouds, end)
        pose, settled, steps = last.transform, last.converged, last.iterations
        if mode == "traced":
            pose = refine.differentiable_pose(how, *clouds, end, last)
    others = call(compare, None, *samples, pose)
    report = call(assess, how is not None, *clouds, pose, settled, others, told).report
    return Outputs(
        transform=pose,
        coarse=start.coarse,
        report=report,
        source_regions=call(label, None, clouds[0], start.source),
        target_regions=call(label, None, clouds[1], start.target),
        steps=steps,
    )


def _look_quickly(options: tuple[ICP, Search], source: Prepared, target: Prepared, plain: Found, told: Told) -> Found:
    """The best pose of a quick look at dense clouds, and whether that settles it: a stage of other stages."""
    refiner, searching = options
    found, unanimous = search_quickly(searching, source.samples, target.samples, plain)
    _, assessment = _tried(refiner, source, target, found.transform, found.width, told)
    return judge_quick_look(searching, found, unanimous, assessment.report.confidence)


def _verified(options: tuple[ICP, Search], source: Prepared, target: Prepared, found: Found, told: Told) -> Found:
    """The finalist in which dense clouds fit best, once all have been refined: a stage of other stages."""
    refiner, searching = options

    def judged(pose: Rigid) -> tuple[Rigid, Array]:
        end, assessment = _tried(refiner, source, target, pose, found.width, told)
        return end, assessment.score

    mode = _mode(source, target, found)
    if mode == "traced":
        ends = jax.lax.map(judged, found.finalists)
    elif mode == "abstract":
        one = judged(found.transform)
        ends = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((search.FINALISTS, *leaf.shape), leaf.dtype), one)
    else:
        rows = range(search.FINALISTS)
        each = [judged(jax.tree.map(lambda leaf, row=row: leaf[row], found.finalists)) for row in rows]
        ends = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
    return choose_finalist(searching, found, *ends)


def _tried(
    refiner: ICP, source: Prepared, target: Prepared, pose: Rigid, width: Array, told: Told
) -> tuple[Rigid, Assessment]:
    """Where refinement of a pose of dense clouds ends, of large ones that of thinned ones, and what is said of it."""
    if source.cloud.mask.shape[-1] > THINNED:
        end, _ = settle_thinned(refiner, source, target, pose, width)
    else:
        end = settle(refiner, source, target, pose, width).transform
    others = compare(None, source.samples, target.samples, end)
    return end, assess(True, source, target, end, np.bool_(True), others, told)


def _not_known(cloud: Cloud) -> Known:
    """That the pose is not known, of a pair or a batch with such a cloud."""
    batch, dtype = cloud.mask.shape[:-1], cloud.points.dtype
    turn: Any = np.broadcast_to(np.eye(3, dtype=dtype), (*batch, 3, 3))
    shift: Any = np.zeros((*batch, 3), dtype)
    sure: Any = np.zeros(batch, bool)
    return Known(Rigid(turn, shift), sure)


def sizes_of(options: Options) -> Sizes:
    """What ``prepare`` is told."""
    refiner = ICP() if options.refine is None else options.refine
    return Sizes(
        sample=max(_SAMPLE, options.model.config.points, 2 * refiner.coarse_points),
        queries=refiner.points,
        normal_radius=refiner.normal_radius,
    )


def _mode(*arguments: Any) -> Literal["traced", "abstract", "concrete"]:
    """Whether programs are to be composed into what is traced, compiled only, or run."""
    leaves = jax.tree.leaves(arguments)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return "traced"
    return "abstract" if any(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves) else "concrete"


def _one_by_one(needed: np.ndarray, program: Callable, arguments: tuple, otherwise: Any) -> Any:
    """The program's answers for the pairs of a batch (B,) that need it, the first argument shared by all."""
    shared, *each = arguments
    host, answers = jax.tree.map(np.asarray, each), jax.tree.map(np.array, otherwise)
    for row in np.flatnonzero(needed):
        answer = program(shared, *jax.tree.map(lambda leaf, row=row: leaf[row], host))
        for leaf, new in zip(jax.tree.leaves(answers), jax.tree.leaves(answer), strict=True):
            leaf[row] = new
    return answers
