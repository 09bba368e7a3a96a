"""Reads the arrays of a released network, named as PyTorch names them, into the variables of our layers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def array(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The array of that name as float32, with every number below the smallest normal one set to zero.

    Weight decay has shrunk many released weights to such subnormal numbers. They change no result, and a CPU computes
    many times slower with them.

    Args:
      arrays: flat names to arrays.
      name: of the array.
      shape: that it must have. The trailing axes of length 1 that a 1×1 convolution has are dropped first.

    Raises:
      ValueError: the array is missing or has another shape.
    """
    if name not in arrays:
        raise ValueError(f"the released weights lack the array {name!r}")
    values = np.asarray(arrays[name], np.float32)
    if values.shape[len(shape) :] == (1,) * (values.ndim - len(shape)):
        values = values.reshape(values.shape[: len(shape)])
    if values.shape != shape:
        raise ValueError(f"released array {name!r}: expected shape {shape}, got {arrays[name].shape}")
    return np.where(np.abs(values) < np.finfo(np.float32).tiny, np.float32(0), values)


def dense(
    arrays: Mapping[str, np.ndarray], name: str, widths: tuple[int, int], *, bias: bool = True
) -> dict[str, np.ndarray]:
    """The parameters of a Flax ``Dense``: "kernel" (C_in, C_out), and "bias" (C_out,) if it has one.

    Args:
      arrays: flat names to arrays.
      name: of a PyTorch linear layer or 1×1 convolution: its weight is (C_out, C_in), with or without axes of length 1.
      widths: C_in and C_out.
      bias: whether it has a bias.

    Raises:
      ValueError: an array is missing or has another shape.
    """
    params = {"kernel": array(arrays, f"{name}.weight", widths[::-1]).T}
    if bias:
        params["bias"] = array(arrays, f"{name}.bias", widths[1:])
    return params


def norm(
    arrays: Mapping[str, np.ndarray], name: str, width: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The parameters and the stored statistics of a ``BatchNorm`` of C = ``width`` features.

    Raises:
      ValueError: an array is missing or has another shape.
    """
    params = {"scale": array(arrays, f"{name}.weight", (width,)), "bias": array(arrays, f"{name}.bias", (width,))}
    stats = {
        "mean": array(arrays, f"{name}.running_mean", (width,)),
        "variance": array(arrays, f"{name}.running_var", (width,)),
    }
    return params, stats


def layer(
    arrays: Mapping[str, np.ndarray], conv: str, bn: str, widths: tuple[int, int], *, bias: bool = False
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The "params" and "batch_stats" of a ``Layer``.

    Args:
      arrays: flat names to arrays.
      conv: name of the linear map, as for ``dense``.
      bn: name of the batch norm.
      widths: C_in and C_out.
      bias: whether the linear map has a bias.

    Raises:
      ValueError: an array is missing or has another shape.
    """
    params, stats = norm(arrays, bn, widths[1])
    linear = dense(arrays, conv, widths, bias=bias)
    return {"Dense_0": linear, "BatchNorm_0": params}, {"BatchNorm_0": stats}


def stack(
    arrays: Mapping[str, np.ndarray],
    names: Sequence[tuple[str, str]],
    inputs: Sequence[int],
    widths: Sequence[int],
    *,
    bias: bool = False,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The "params" and "batch_stats" of a module whose ``Layer``s are all that it has: "Layer_0", "Layer_1", ….

    Args:
      arrays: flat names to arrays.
      names: of the linear map and the batch norm of each layer, as for ``layer``.
      inputs: C_in of each layer.
      widths: C_out of each layer.
      bias: whether the linear maps have one.

    Raises:
      ValueError: an array is missing or has another shape.
    """
    sizes = zip(inputs, widths, strict=True)
    layers = [layer(arrays, *pair, size, bias=bias) for pair, size in zip(names, sizes, strict=True)]
    params, stats = ({f"Layer_{row}": each[which] for row, each in enumerate(layers)} for which in (0, 1))
    return params, stats
