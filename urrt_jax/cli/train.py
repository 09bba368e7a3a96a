"""``urrt train``: our network from shapes, without labels, or a learned method of the tables by its own loss."""

from __future__ import annotations

import json
import os
import shlex
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from urrt_jax.training.state import TrainConfig
    from urrt_jax.training.trainable import Trainable, Variables

# These mirror the library's configurations, with the same names and defaults (a test compares them): importing those
# would import JAX, and --help would take seconds.


@dataclass(frozen=True, kw_only=True)
class NetworkFlags:
    """The network's shape.

    Attributes:
        variant: A: one decoder, no regions. B: regions, attention, one decoder a region. C: as B, and the attention
            knows where the regions are.
        regions: Regions that the network cuts a cloud into.
        partition: What tells regions apart: where points lie, or what surrounds them, so that regions turn with the
            shape.
        width: Dimension of the embeddings.
        attention_layers: Self-attention layers over the regions.
        decoder: What a region's decoder gives: landmarks to align, or the pose itself.
        landmarks: Landmarks that a region asks for.
        sharpness: How sharply fresh landmarks choose among points.
        octaves: Widths at which the surroundings of points are described; 0: not at all.
        lookups: Points of each cloud that are looked up in both; 0: none.
        consensus: Rounds in which landmarks that disagree with the others lose weight.
        hypotheses: Hypotheses of the pose; the rounds of consensus start from the best one. 0: none. Not in training.
        steps: How often the network is applied, each time to the source as moved so far.
        points: Points of a cloud that the network looks at.
    """

    variant: Literal["A", "B", "C"] = "C"
    regions: int = 8
    partition: Literal["places", "parts"] = "places"
    width: int = 128
    attention_layers: int = 1
    decoder: Literal["landmarks", "pose"] = "landmarks"
    landmarks: int = 8
    sharpness: float = 4.0
    octaves: int = 4
    lookups: int = 512
    consensus: int = 12
    hypotheses: int = 64
    steps: int = 3
    points: int = 512


@dataclass(frozen=True, kw_only=True)
class PairFlags:
    """How the training pairs are drawn and spoiled; the shapes have radius 1.

    Attributes:
        points: Points drawn of a shape.
        max_angle: Largest rotation about each axis, in degrees.
        signed: Share of pairs whose angles take random signs; the others turn one way only, as in DCP's protocol.
        translation: Largest translation along each axis.
        both_ways: Share of pairs whose source is the turned cloud; in the others it is the target, as in DCP's.
        clean_share: First share of the steps in which all pairs are clean.
        ramp_share: Share of the steps in which spoiled pairs come in.
        corrupted: Share of pairs that are spoiled after that.
        noise: Largest standard deviation of the noise on every coordinate.
        cropped: Share of the clouds of spoiled pairs that are cropped, each for itself.
        keep: Smallest share of a cloud that a crop leaves.
        outliers: Largest share of points replaced by stray ones.
    """

    points: int = 1024
    max_angle: float = 45.0
    signed: float = 0.5
    translation: float = 0.5
    both_ways: float = 0.5
    clean_share: float = 0.0
    ramp_share: float = 0.1
    corrupted: float = 0.75
    noise: float = 0.02
    cropped: float = 0.75
    keep: float = 0.5
    outliers: float = 0.2


_OURS = (
    "model",
    "start",
    "queries",
    "occupancy_weight",
    "agreement_weight",
    "loss_points",
    "unrolled",
    "lookups",
    "rounds",
)
"""The flags that belong to our own network."""


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train our network on shapes, without labels; or, with --method, a learned method that it is compared with, by the
    loss of its paper, on the same pairs and with the same optimiser.

    The same command continues a run that was stopped. The folder gets config.json, metrics.jsonl, checkpoints/ and at
    the end model.npz with its card model.json: 'urrt register A B --model DIR/model.npz' uses our network. Ctrl-C
    saves first.

    A trial run on made-up shapes: urrt train --out runs/trial --steps 100 --every 50

    On ModelNet40: urrt train --out runs/modelnet40 --data ModelNet40/

    From trained weights: urrt train --out runs/mine --data shapes/ --start modelnet40 --steps 1000

    Another method: urrt train --out runs/dcp --data ModelNet40/ --method dcp_v2

    Exit codes: 0, the model was written. 2, wrong use or bad input. 130, stopped by Ctrl-C.

    Attributes:
        out: Folder of the run.
        method: What is trained: 'urrt', our network, or another learned method.
        start: Name of a packaged model, or a file written by 'urrt train', whose weights a new run begins with. Weights
            that have no counterpart of the same shape there are random.
        data: 'procedural', a .npz file, a folder of ModelNet40, or a folder of meshes or clouds; by default $URRT_DATA,
            else 'procedural'. Each file is a whole shape; a cloud needs at least --pairs.points points.
        limit: Use at most this many shapes.
        categories: Only shapes of the first so many categories; the others stay unseen.
        queries: Points a shape whose inside and outside teach the regions, where meshes are closed; 0 uses a shell
            around the cloud instead.
        validation_share: Share of the training shapes that is held out to choose the best checkpoint by.
        steps: Optimiser steps.
        batch: Pairs a step.
        learning_rate: Its peak; it falls to a hundredth by the end. By default the published one of the method; of
            ours 1e-3.
        warmup: Steps in which the learning rate rises.
        occupancy_weight: Weight of the loss that teaches the regions, against the distance of the clouds.
        agreement_weight: Where regions are parts: weight of the loss that cuts all clouds of a shape alike; it is
            multiplied by --occupancy-weight.
        loss_points: Points of each cloud that the loss compares, at most --pairs.points.
        unrolled: How many of the network's steps are run in training, at most --model.steps.
        lookups: Points of each cloud that are looked up in training, at most the model's.
        rounds: Rounds of consensus in training, at most --model.consensus. Landmarks that are not trained yet do not
            agree, so that few rounds are enough.
        steps_per_call: Steps in one dispatch; more of them help on an accelerator.
        seed: Random seed of the first weights and of the training pairs.
        every: Steps between validations, each followed by a checkpoint.
        log_every: Steps between lines of metrics.jsonl.
        validation_pairs: Pairs of each kind in a validation.
        patience: Validations without a better one after which training stops; 0: never.
        minutes: Minutes of training in all after which it stops, stopped runs counted on and validations not counted;
            by default there is no limit. The learning rate falls with --steps all the same.
        model: Our network.
        pairs: The training pairs.
    """

    out: Path
    method: Literal[
        "urrt", "dcp_v1", "dcp_v2", "prnet", "rpmnet", "deepgmr", "pointnetlk", "pointnetlk_revisited", "rienet"
    ] = "urrt"
    start: str | None = None
    data: str | None = None
    limit: int | None = None
    categories: int | None = None
    queries: int = 0
    validation_share: float = 0.05
    steps: int = 8_000
    batch: int = 32
    learning_rate: float | None = None
    warmup: int = 200
    occupancy_weight: float = 0.02
    agreement_weight: float = 2.0
    loss_points: int = 512
    unrolled: int = 2
    lookups: int = 256
    rounds: int = 4
    steps_per_call: int = 1
    seed: int = 0
    every: int = 500
    log_every: int = 50
    validation_pairs: int = 256
    patience: int = 0
    minutes: float | None = None
    model: NetworkFlags = NetworkFlags()
    pairs: PairFlags = PairFlags()

    def config(self) -> TrainConfig:
        """The library's configuration of this run.

        Raises:
          ValueError: a flag of our network was given with another method, or a value is refused.
        """
        from urrt_jax.training.pairs import PairConfig
        from urrt_jax.training.state import TrainConfig

        method, learning_rate = self._method()
        names = {field.name for field in fields(TrainConfig)} - {"method", "pairs", "learning_rate"}
        return TrainConfig(
            method=method,
            pairs=PairConfig(**asdict(self.pairs)),
            learning_rate=learning_rate if self.learning_rate is None else self.learning_rate,
            **{name: value for name, value in vars(self).items() if name in names},
        )

    def _method(self) -> tuple[Trainable, float]:
        """What is trained, and its published learning rate."""
        if self.method == "urrt":
            from urrt_jax.model import ModelConfig
            from urrt_jax.training.state import TrainConfig
            from urrt_jax.training.urrt import URRT

            names = {field.name for field in fields(URRT)} - {"model"}
            own = {name: value for name, value in vars(self).items() if name in names}
            return URRT(model=ModelConfig(**asdict(self.model)), **own), TrainConfig.learning_rate

        from urrt_jax.cli.printing import changed_flags
        from urrt_jax.peers.learned.weights import NETWORKS

        ours = tuple("--" + name.replace("_", "-") for name in _OURS)
        if wrong := [flag for flag in changed_flags(self) if flag.partition(".")[0] in ours]:
            raise ValueError(f"{', '.join(wrong)}: only for our own network, not for --method {self.method}")
        network = NETWORKS[self.method]
        return network, network.learning_rate

    def run(self) -> int:
        """Trains, and writes the best model with its card."""
        from importlib.metadata import version

        import jax

        from urrt_jax import __version__, load_model, model_card
        from urrt_jax.cli.interrupt import leave_ctrl_c_to_python
        from urrt_jax.cli.printing import print_skipped
        from urrt_jax.cli.streams import note
        from urrt_jax.data import find_data, load_shapes
        from urrt_jax.training.loop import LoopConfig, train
        from urrt_jax.training.state import counterparts

        config, source = self.config(), find_data(self.data)
        start = None if self.start is None else load_model(self.start).params
        loop = LoopConfig(
            every=self.every,
            log_every=self.log_every,
            validation_pairs=self.validation_pairs,
            patience=self.patience,
            minutes=self.minutes,
        )
        loaded = load_shapes(source, points=self.pairs.points, limit=self.limit, queries=self.queries, progress=True)
        if self.categories is not None:
            loaded = loaded.first_categories(self.categories)
        shapes, validation = loaded.split_validation(self.validation_share, self.seed)
        note(f"{len(shapes)} shapes to train on, {len(validation)} held out")
        print_skipped(loaded.skipped)
        own = {}
        if self.method == "urrt":
            surface = "a shell around each cloud" if loaded.queries is None else "inside and outside of closed meshes"
            note(f"the regions learn from {surface}")
            own = {"occupancy": surface}
        if self.start is not None and start is not None:
            own |= {"start": {"model": Path(self.start).stem, "sha256": model_card(self.start)["sha256"]}}
            taken = counterparts(config.method.init(jax.random.key(0))["params"], start)
            given = len(jax.tree.leaves(start))
            note(f"{len(taken)} of the {given} arrays of {self.start} have their place in this network")
        leave_ctrl_c_to_python()  # the loop saves first
        try:
            variables = train(config, shapes, validation, self.out, start=start, loop=loop)
        except KeyboardInterrupt:
            note(f"stopped; the same command continues the run in {self.out}")
            return 130
        log = self.out / "metrics.jsonl"
        steps, seconds = trained(log)
        card = {
            "command": self.command(),
            "data": Path(source).name,
            "shapes": len(shapes),
            "validation_shapes": len(validation),
            "steps": steps,
            "seconds": seconds,
            **own,
            "training": config.as_dict(),
            "versions": {"urrt_jax": __version__} | {name: version(name) for name in ("jax", "flax", "optax")},
            "processor": f"{os.cpu_count()} cores, {jax.devices()[0].device_kind}",
            "validation": best_validation(log),
            "log": validations(log),
        }
        path = self._save(config.method, variables, card)
        note(f"wrote {path}")
        return 0

    def _save(self, method: Any, variables: Variables, card: dict[str, Any]) -> Path:
        """Writes what was trained, and returns the path of its arrays."""
        if self.method == "urrt":
            from urrt_jax import save_model

            return save_model(method.as_model(variables), self.out / "model.npz", card)

        from urrt_jax.peers.learned.weights import save_network

        return save_network(method, variables, self.out / "model.npz", card)

    def command(self) -> str:
        """The command line of this run, with names in the place of paths."""
        from urrt_jax.cli.printing import changed_flags

        return shlex.join(["urrt", "train", *changed_flags(self)])


def trained(log: Path) -> tuple[int, float]:
    """The steps and the seconds that a run was trained, as its metrics.jsonl says."""
    entries = _entries(log)
    return max(entry["step"] for entry in entries), max(entry.get("seconds", 0.0) for entry in entries)


def validations(log: Path) -> list[dict[str, Any]]:
    """The validations in a run's metrics.jsonl, in their order."""
    return [entry for entry in _entries(log) if entry.pop("kind") == "validation"]


def best_validation(log: Path) -> dict[str, Any]:
    """The validation with the smallest loss; empty where there is none."""
    from urrt_jax.training.checkpoints import ranking_loss

    return min(validations(log), key=lambda entry: ranking_loss(entry["validation_loss"]), default={})


def _entries(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()]
