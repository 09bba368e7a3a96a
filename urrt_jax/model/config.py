"""The network's static configuration, validated when it is made."""

import dataclasses
import json
from typing import Literal

from urrt_jax.checks import check_positive, check_whole


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Everything that fixes the network's shape; hashable, static under jit, stored beside the weights.

    Attributes:
      variant: the paper's models. "A": one decoder conditioned on the shape embeddings, no regions. "B": regions,
        attention and one decoder a region. "C": B with the position encoding of the regions' centroids.
      regions: n, the number of regions (8 and 12 in BAE-NET).
      width: d, the dimension of embeddings and region features.
      encoder_widths: hidden widths of the point encoder, before its last layer of ``width``.
      partition: what the branches h_k see of a point. "places": where it lies, as in the paper; regions follow the
        pose. "parts": what surrounds it, which no pose changes (needs ``octaves``).
      branch_width: hidden width of every branch h_k; those that see surroundings share two layers of twice this width.
      position_widths: hidden widths of the position encoding δ.
      attention_layers: self-attention layers over the regions.
      decoder: what the decoders g_k give. "landmarks": the places of ``landmarks`` matching landmarks in both clouds,
        which are then aligned. "pose": the transform itself, regressed.
      decoder_widths: hidden widths of every decoder g_k.
      landmarks: landmarks of a region.
      key_width: dimension in which landmarks and points are compared by place, and again by surroundings.
      sharpness: factor of the logits of landmarks; fresh networks with more of it choose fewer points.
      octaves: widths at which the points' surroundings are described (``features/moments.py``); 0: not at all. Parts
        and landmarks are told apart by them.
      lookups: points of each cloud that are looked up in both, for landmarks too.
      consensus: rounds in which landmarks that disagree with the others are weighed down.
      hypotheses: of the pose, the best of which the first of these rounds starts from; 0: from none.
      steps: K, how often the network is applied, each time to the source moved by the estimate so far.
      points: points of a cloud that the network looks at; larger clouds are subsampled (``subsample``).
    """

    variant: Literal["A", "B", "C"] = "C"
    regions: int = 8
    width: int = 128
    encoder_widths: tuple[int, ...] = (64, 64, 128)
    partition: Literal["places", "parts"] = "places"
    branch_width: int = 32
    position_widths: tuple[int, ...] = (64,)
    attention_layers: int = 1
    decoder: Literal["landmarks", "pose"] = "landmarks"
    decoder_widths: tuple[int, ...] = (128,)
    landmarks: int = 8
    key_width: int = 32
    sharpness: float = 4.0
    octaves: int = 4
    lookups: int = 512
    consensus: int = 12
    hypotheses: int = 64
    steps: int = 3
    points: int = 512

    def __post_init__(self) -> None:
        if self.variant not in ("A", "B", "C"):
            raise ValueError(f"variant: expected 'A', 'B' or 'C', got {self.variant!r}")
        if self.partition not in ("places", "parts"):
            raise ValueError(f"partition: expected 'places' or 'parts', got {self.partition!r}")
        if self.decoder not in ("landmarks", "pose"):
            raise ValueError(f"decoder: expected 'landmarks' or 'pose', got {self.decoder!r}")
        check_whole(self, regions=1, width=1, branch_width=1, attention_layers=0, landmarks=1, key_width=1)
        check_positive(self, "sharpness")
        check_whole(self, octaves=0, lookups=0, consensus=0, hypotheses=0, steps=1, points=3)
        if self.has_regions and self.partition == "parts" and not self.octaves:
            raise ValueError("octaves: parts are told apart by the surroundings of points, got 0 widths of them")
        for name in ("encoder_widths", "position_widths", "decoder_widths"):
            widths = getattr(self, name)
            object.__setattr__(self, name, tuple(widths))
            if any(type(width) is not int or width < 1 for width in widths):
                raise ValueError(f"{name}: expected positive integers, got {widths}")

    @property
    def has_regions(self) -> bool:
        """Whether this is one of the paper's models with regions (B and C)."""
        return self.variant != "A"

    def to_json(self) -> str:
        """The configuration as JSON."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    @classmethod
    def from_dict(cls, fields: dict) -> "ModelConfig":
        """The configuration with these fields.

        Raises:
          ValueError: a field that this version does not know.
        """
        unknown = sorted(set(fields) - {field.name for field in dataclasses.fields(cls)})
        if unknown:
            raise ValueError(f"model configuration: unknown fields {unknown}")
        return cls(**fields)
