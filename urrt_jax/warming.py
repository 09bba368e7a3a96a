"""Compilation ahead of time."""

from collections.abc import Sequence
from typing import Literal

from urrt_jax.host import abstract_pair
from urrt_jax.model.network import Model
from urrt_jax.programs import wait_until_ready
from urrt_jax.refine import ICP
from urrt_jax.registration import check_options, make_options
from urrt_jax.search import Search
from urrt_jax.stages import Options, prepare, register_in_frame, rung, sizes_of


def warm_up(
    sizes: Sequence[int] = (1024,),
    *,
    model: Model | None = None,
    refine: ICP | None = ICP(),
    search: Search | Literal["auto"] | None = "auto",
    rare: bool = True,
    progress: bool = False,
) -> None:
    """Returns when all that ``register`` may run for clouds of these sizes is compiled, or loaded from disk.

    Without it ``register`` compiles at its first call for each rung of the ladder of sizes (256, 1,024, 4,096, …), and
    once more when a pair first needs a search. With ``use_compilation_cache`` a later process loads what an earlier
    one compiled. The arguments are those of the calls to come; numbers in ``refine`` and ``search`` that fix no shape
    may differ.

    Args:
      sizes: numbers of points of the larger cloud of a pair.
      model: as for ``register``.
      refine: as for ``register``.
      search: as for ``register``.
      rare: whether to compile also what few pairs need, such as the search, which takes as long as all else.
      progress: shows a bar on stderr.

    Raises:
      ValueError: no sizes, or a size that is not a positive whole number; options as ``register`` refuses them.
    """
    check_options(model, refine, search, None)
    if isinstance(sizes, int) or not sizes or not all(isinstance(size, int) and size > 0 for size in sizes):
        raise ValueError(f"sizes: expected positive whole numbers, at least one, got {sizes!r}")
    options = make_options(model, refine, search)
    for size in sorted(set(map(rung, sizes))):
        register_in_frame(options, *abstract_pair(size), rare=rare)
    wait_until_ready(progress)


def is_warm(size: int, options: Options) -> bool:
    """Whether the first program for clouds of this size is compiled or on disk. If not, its compilation begins."""
    cloud, _, _ = abstract_pair(rung(size))
    prepare(sizes_of(options), cloud)
    return prepare.is_ready(sizes_of(options), cloud)
