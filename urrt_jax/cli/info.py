"""``urrt info``: versions, devices, models, the cache of compiled programs, and optional libraries."""

from __future__ import annotations

import json as json_format
from dataclasses import dataclass
from typing import Any

_VERSIONS = ("jax", "jaxlib", "flax", "numpy")
# What each extra is for, and the modules by which it is told.
_EXTRAS = {
    "viz": ("pictures", ("matplotlib",)),
    "data": ("HDF5 data sets, .pcd, .las and .laz files", ("h5py", "pypcd4", "laspy", "lazrs")),
    "peers": ("other methods of 'urrt evaluate'", ("open3d", "small_gicp", "kiss_matcher", "jaxkd")),
}


@dataclass(frozen=True, kw_only=True)
class Info:
    """Show what is installed: versions, devices, packaged models, the cache of compiled programs, optional libraries.

    For a bug report: urrt info

    Attributes:
        json: Print one JSON object: versions, devices, models, cache (folder, programs, bytes), extras.
        clear_cache: First remove all compiled programs from the cache folder; the next call of each size compiles anew.
    """

    json: bool = False
    clear_cache: bool = False

    def run(self) -> int:
        """Prints what is installed."""
        from urrt_jax.cli.streams import note, show
        from urrt_jax.program_cache import cached_files

        if self.clear_cache:
            _, sizes = cached_files()
            for path in sizes:
                path.unlink(missing_ok=True)
            note(f"removed {len(sizes)} compiled programs, {_megabytes(sum(sizes.values()))}")
        found = installed()
        show(json_format.dumps(found) if self.json else as_text(found))
        return 0


def installed() -> dict[str, Any]:
    """Versions, devices, models, cache and extras, as JSON has them."""
    import platform
    from importlib.metadata import version
    from importlib.util import find_spec

    import jax

    from urrt_jax import __version__, available_models, model_card
    from urrt_jax.program_cache import cached_files

    folder, sizes = cached_files()
    return {
        "versions": {
            "urrt_jax": __version__,
            **{name: version(name) for name in _VERSIONS},
            "python": platform.python_version(),
        },
        "devices": [f"{device.platform}: {device.device_kind}" for device in jax.devices()],
        "models": {name: _one_line(model_card(name)) for name in available_models()},
        "cache": {"folder": str(folder), "programs": len(sizes), "bytes": sum(sizes.values())},
        "extras": {
            extra: {module: find_spec(module) is not None for module in modules}
            for extra, (_, modules) in _EXTRAS.items()
        },
    }


def as_text(found: dict[str, Any]) -> str:
    """What ``installed`` returns, for a person."""
    rows = [(name, said) for name, said in found["versions"].items()]
    rows += [("device", said) for said in found["devices"]]
    rows += [(f"model {name}", said) for name, said in found["models"].items()]
    cache = found["cache"]
    rows.append(("cache", f"{cache['folder']}: {cache['programs']} compiled programs, {_megabytes(cache['bytes'])}"))
    for extra, modules in found["extras"].items():
        missing = [module for module, there in modules.items() if not there]
        how = f"missing {', '.join(missing)}: pip install 'urrt-jax[{extra}]'" if missing else "installed"
        rows.append((f"extra {extra}", f"{how}, for {_EXTRAS[extra][0]}"))
    width = max(len(name) for name, _ in rows) + 2
    return "\n".join(f"{name:<{width}}{said}" for name, said in rows)


def _one_line(card: dict[str, Any]) -> str:
    """What a model is, in a line."""
    return f"{card['limits']} Trained on {card['shapes']:,} shapes of {card['data']}."


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB"
