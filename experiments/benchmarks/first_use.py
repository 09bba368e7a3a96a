"""How long a user waits: whole processes, from their start, with an empty and with a filled cache of compiled programs.

    python experiments/benchmarks/first_use.py [--data PATH] [--only CASE ...] [--repeats 3]

Every measurement is a process of its own, whose cache folder (XDG_CACHE_HOME) is a temporary one: once while it is
empty, when every program must be compiled, then --repeats times while it is filled (the median counts). Matplotlib
keeps its list of fonts in the same folder, so the first `urrt demo` makes that list too. Libraries are loaded once
before, so that their files are in memory: reading them from the disk is not measured.

Beside ours, Open3D registers the same clouds in a new process: FPFH, RANSAC and ICP with the settings of the peers
`ransac_icp` and `scan_ransac`, in turns with the runs that find the cache filled. It keeps no programs, so it has one
number. That process also imports `urrt_jax.peers`, for the settings; the seconds of this import are subtracted.

PATH is a folder with bunny_scans.npz, or that file ($URRT_DATA by default); without it the cases with scans are left
out. Results are saved after every case, and cases that are not measured keep their earlier results. Open3D is optional:
`pip install 'urrt-jax[peers]'`; Debian: libusb-1.0-0 libgl1 libegl1 libgomp1.
"""

import argparse
import dataclasses
import importlib
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# Modules of urrt_jax are imported inside the functions that need them: this file is also the program of the measured
# processes, which must import nothing that a user's program would not.

HERE = Path(__file__).parent
SCANS = "bunny_scans.npz"
SCAN_PAIRS = 20
SCAN_FILES = ("bun000", "bun045")
FOLDER_SCANS = 100
SIZES = ((1024, 1024), (1000, 900), (999, 901), (500, 600))
FOUND_DEGREES = 5.0  # a pose that is nearer to the truth counts as found
STARTED = "FIRST_USE_STARTED"  # the environment variable that tells a process when it was started
COMMAND = ("-m", "urrt_jax.cli")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One thing that a user does.

    Attributes:
      title: what the table calls it.
      asked: the seconds that we want to stay below with an empty and with a filled cache.
      ours: the arguments of Python in our process.
      open3d: those in Open3D's process; None where Open3D has no such thing.
      pairs: what the table calls the pairs, in their order.
      rotations: the true rotation (3, 3) of every pair, where the process tells which it found.
      headline: what the asked seconds are compared with: "whole", from start to exit, or "first_result", from start to
        the first pose.
    """

    title: str
    asked: dict[str, float]
    ours: tuple[str, ...]
    open3d: tuple[str, ...] | None = None
    pairs: tuple[str, ...] = ()
    rotations: tuple[np.ndarray, ...] = ()
    headline: str = "whole"


# The measured processes.


def _our_aligner() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """What a user's program does before its first pair; the function gives a rotation (3, 3)."""
    import urrt_jax

    urrt_jax.use_compilation_cache()
    register = urrt_jax.register
    import jax

    return lambda source, target: np.asarray(jax.block_until_ready(register(source, target)).rotation)


def _open3d_aligner(name: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The same with a peer of this name."""
    from urrt_jax.peers import PEERS

    importlib.import_module("open3d")

    def align(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        try:
            return PEERS[name].align_pair(source, target)[:3, :3]
        except RuntimeError:  # no sample had an inlier: a pose that is not found
            return np.eye(3)

    return align


def _child(method: str, *files: str) -> dict:
    """The seconds of one process that registers pairs, and the rotations that it found.

    One file is an .npz of pairs as `_write_pairs` writes it; two files are the two clouds of one pair.
    """
    started, subtracted = float(os.environ[STARTED]), 0.0
    if method != "ours":
        begin = time.monotonic()
        importlib.import_module("urrt_jax.peers")
        subtracted = time.monotonic() - begin
    begin = time.monotonic()
    align = _our_aligner() if method == "ours" else _open3d_aligner(method)
    imported = time.monotonic() - begin
    if len(files) == 2:
        read = importlib.import_module("open3d").io.read_point_cloud
        pairs = [tuple(np.asarray(read(file).points) for file in files)]
    else:
        with np.load(files[0]) as archive:
            clouds = [archive[name] for name in archive.files]
        pairs = list(zip(clouds[::2], clouds[1::2], strict=True))
    seconds, rotations, first_result = [], [], 0.0
    for source, target in pairs:
        begin = time.monotonic()
        rotations.append(align(source, target).tolist())
        end = time.monotonic()
        seconds.append(end - begin)
        first_result = first_result or end - started - subtracted
    return {
        "rotations": rotations,
        "subtracted": subtracted,
        "seconds": {"first_result": first_result, "import": imported, "pairs": seconds},
    }


def _run(arguments: tuple[str, ...], cache: str) -> tuple[dict, list]:
    """The seconds of one process, and the rotations that it found."""
    ignored = ("URRT_NO_CACHE", "JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE", "MPLCONFIGDIR")
    environment = {name: value for name, value in os.environ.items() if name not in ignored}
    started = time.monotonic()  # of one clock for all processes of a machine
    environment |= {"XDG_CACHE_HOME": cache, STARTED: repr(started)}
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True)
    whole = time.monotonic() - started
    if done.returncode not in (0, 1):  # 1: a pair has not converged
        raise RuntimeError(f"{' '.join(arguments)}: exit code {done.returncode}\n{done.stderr[-4000:]}")
    last = (done.stdout.splitlines() or [""])[-1]
    told = json.loads(last) if last.startswith("{") else {}
    if "matrix" in told:  # of `urrt register --json`
        return {"whole": whole}, [[row[:3] for row in told["matrix"][:3]]]
    if "results" in told:  # of many pairs
        return {"whole": whole}, [[row[:3] for row in each["matrix"][:3]] for each in told["results"]]
    return {"whole": whole - told.get("subtracted", 0.0)} | told.get("seconds", {}), told.get("rotations", [])


# The cases.


def _write_pairs(file: Path, pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """An .npz of source and target of every pair, in turns."""
    np.savez(file, *[cloud for pair in pairs for cloud in pair])


def _pair_case(folder: Path, data: Path) -> Case:
    from scipy.spatial.transform import Rotation

    from urrt_jax.data import demo_shape

    random = np.random.default_rng(0)
    pairs, rotations = [], []
    for number, (moved, fixed) in enumerate(SIZES):
        shape = demo_shape(moved + fixed, seed=number)
        rotation = Rotation.from_euler("zyx", random.uniform(-45, 45, size=3), degrees=True).as_matrix()
        target = shape[moved:] @ rotation.T + random.uniform(-0.5, 0.5, size=3)
        pairs.append((shape[:moved], target.astype(np.float32)))
        rotations.append(rotation)
    file = folder / "pairs.npz"
    _write_pairs(file, pairs)
    return Case(
        title="import, and register one pair of 1,024 points",
        asked={"empty": 8, "filled": 2},
        ours=(__file__, "--child", "ours", str(file)),
        open3d=(__file__, "--child", "ransac_icp", str(file)),
        pairs=tuple(f"{moved:,} × {fixed:,} points" for moved, fixed in SIZES),
        rotations=tuple(rotations),
        headline="first_result",
    )


def _scans_case(folder: Path, data: Path) -> Case:
    from urrt_jax.evaluation.scans import load_scan_pairs

    trials, about = load_scan_pairs(_scans(data))
    chosen = evenly_spread(len(trials), SCAN_PAIRS)
    file = folder / "scans.npz"
    _write_pairs(file, [(trials[item].source, trials[item].target) for item in chosen])
    return Case(
        title=f"import, and register {len(chosen)} pairs of scans of 30,000 to 40,000 points",
        asked={"empty": 40, "filled": 10},
        ours=(__file__, "--child", "ours", str(file)),
        open3d=(__file__, "--child", "scan_ransac", str(file)),
        pairs=tuple(f"{about[item]['source']} → {about[item]['target']}" for item in chosen),
        rotations=tuple(trials[item].rotation for item in chosen),
    )


def _demo_case(folder: Path, data: Path) -> Case:
    return Case(
        title="`urrt demo`",
        asked={"empty": 12, "filled": 3},
        ours=(*COMMAND, "demo", "--out", str(folder / "demo.png")),
    )


def _register_case(folder: Path, data: Path) -> Case:
    from urrt_jax.evaluation.scans import load_scan_pairs
    from urrt_jax.io import write_cloud

    trials, about = load_scan_pairs(_scans(data))
    names = [(each["source"], each["target"]) for each in about]
    trial = trials[names.index(SCAN_FILES)]
    files = tuple(str(folder / f"{name}.ply") for name in SCAN_FILES)
    for file, cloud in zip(files, (trial.source, trial.target), strict=True):
        write_cloud(file, cloud)
    return Case(
        title="`urrt register` of two files of 40,000 points",
        asked={"empty": 15, "filled": 2.5},
        ours=(*COMMAND, "register", *files, "--json"),
        open3d=(__file__, "--child", "scan_ransac", *files),
        pairs=(" → ".join(SCAN_FILES),),
        rotations=(trial.rotation,),
    )


def _folder_case(folder: Path, data: Path) -> Case:
    """Scans that overlap one, each several times: every time other points of it, another number, another pose."""
    from scipy.spatial.transform import Rotation

    from urrt_jax.evaluation.scans import load_scan_pairs
    from urrt_jax.io import write_cloud

    trials, about = load_scan_pairs(_scans(data))
    chosen = [trial for trial, each in zip(trials, about, strict=True) if each["target"] == SCAN_FILES[0]]
    random = np.random.default_rng(0)
    scans, target, rotations = folder / "scans", folder / "target.ply", []
    scans.mkdir()
    write_cloud(target, chosen[0].target)
    for number in range(FOLDER_SCANS):
        trial = chosen[number % len(chosen)]
        rows = random.permutation(len(trial.source))[: random.integers(20_000, len(trial.source))]
        turn = Rotation.random(rng=random).as_matrix()
        write_cloud(scans / f"{number:03}.ply", trial.source[np.sort(rows)] @ turn.T)
        rotations.append(trial.rotation @ turn.T)
    return Case(
        title=f"`urrt register` of a folder: {FOLDER_SCANS} scans of 20,000 to 40,000 points",
        asked={"empty": 80, "filled": 50},
        ours=(*COMMAND, "register", str(scans), "--to", str(target), "--json"),
        pairs=tuple(f"{number:03}" for number in range(FOLDER_SCANS)),
        rotations=tuple(rotations),
    )


def _help_case(folder: Path, data: Path) -> Case:
    return Case(title="`urrt --help`", asked={"empty": 0.3, "filled": 0.3}, ours=(*COMMAND, "--help"))


CASES: dict[str, Callable[[Path, Path], Case]] = {
    "pair": _pair_case,
    "scans": _scans_case,
    "demo": _demo_case,
    "register": _register_case,
    "folder": _folder_case,
    "help": _help_case,
}


def _scans(data: Path) -> Path:
    """The file of the scans; raises FileNotFoundError where there is none."""
    file = data / SCANS if data.is_dir() else data
    if not file.is_file():
        raise FileNotFoundError(f"no {SCANS} in --data")
    return file


def evenly_spread(total: int, count: int) -> list[int]:
    """At most `count` of the numbers from 0 to total - 1, the first and the last among them."""
    return np.linspace(0, total - 1, min(count, total)).round().astype(int).tolist()


# Measuring.


def medians(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The median of every number over the runs, and of every entry where it is a list; rounded to milliseconds."""
    return {name: np.median([run[name] for run in runs], axis=0).round(3).tolist() for name in runs[0]}


def measure(case: Case, repeats: int, open3d_missing: str | None) -> dict:
    """The results of a case: for each column the seconds, and of how many pairs the pose was found."""
    runs: dict[str, list[dict]] = {"empty": [], "filled": [], "open3d": []}

    def run(column: str, arguments: tuple[str, ...], cache: str) -> None:
        from urrt_jax.evaluation.metrics import rotation_degrees

        seconds, rotations = _run(arguments, cache)
        if rotations:
            errors = rotation_degrees(np.array(rotations), np.stack(case.rotations))
            seconds["found"] = int(np.sum(errors < FOUND_DEGREES))
        runs[column].append(seconds)
        _tell(f"{case.title}: {column} {seconds[case.headline]:.2f} s")

    with tempfile.TemporaryDirectory() as cache:
        run("empty", case.ours, cache)
        for _ in range(repeats):
            run("filled", case.ours, cache)
            if case.open3d and not open3d_missing:
                run("open3d", case.open3d, cache)
    result = {"title": case.title, "headline": case.headline, "asked": case.asked, "repeats": repeats}
    result |= {"pairs": list(case.pairs)} if case.pairs else {}
    result |= {column: medians(each) for column, each in runs.items() if each}
    if case.open3d and open3d_missing:
        result["open3d_not_measured"] = open3d_missing
    return result | {"measured_on": _measured_on()}


def _measured_on() -> dict:
    """The machine and the versions, without a path or a name of the machine."""
    versions = {"python": platform.python_version()}
    for package in ("jax", "jaxlib", "numpy", "urrt-jax", "open3d-cpu", "open3d"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {"processor": _processor(), "cores": os.cpu_count(), "versions": versions}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):  # not Linux, or a processor that does not say
        return platform.processor() or platform.machine()


def _tell(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


# Files.


def load(folder: Path) -> dict:
    """The cases that an earlier run saved, by name."""
    file = folder / "first_use.json"
    return json.loads(file.read_text())["cases"] if file.is_file() else {}


def save(folder: Path, cases: dict, command: str) -> None:
    """Writes both files, with the cases in the order of CASES."""
    from urrt_jax.atomic import write_atomically

    ordered = {name: cases[name] for name in CASES if name in cases}
    result = {"command": command, "cases": ordered}
    write_atomically(folder / "first_use.json", json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    write_atomically(folder / "first_use.md", as_markdown(ordered))


def as_markdown(cases: dict) -> str:
    """The table, then the machines and versions that it was measured with."""
    columns = ("empty", "filled", "open3d")
    lines = ["| seconds | empty cache | goal | filled cache | goal | Open3D |", "|---|---:|---:|---:|---:|---:|"]
    for case in cases.values():
        values = {column: _table_rows(case, case[column]) for column in columns if column in case}
        for row in values["empty"]:
            empty, filled, open3d = (values.get(column, {}).get(row, "") for column in columns)
            asked = [f"≤ {case['asked'][column]:g}" if row == case["title"] else "" for column in columns[:2]]
            lines.append(f"| {row} | {empty} | {asked[0]} | {filled} | {asked[1]} | {open3d} |")
    notes = [
        f"Open3D was not measured for “{case['title']}”: {case['open3d_not_measured']}."
        for case in cases.values()
        if "open3d_not_measured" in case
    ]
    machines: dict[str, list[str]] = {}
    for name, case in cases.items():
        on = case["measured_on"]
        versions = ", ".join(f"{package} {version}" for package, version in on["versions"].items())
        text = f"{on['processor']}, {on['cores']} cores; {versions}; median of {case['repeats']} with a filled cache"
        machines.setdefault(text, []).append(name)
    notes += [f"Measured on {text} ({', '.join(names)})." for text, names in machines.items()]
    return "\n".join(lines) + "\n\n" + "\n\n".join(notes) + "\n"


def _table_rows(case: dict, numbers: dict) -> dict[str, str]:
    """What one column says in the rows of a case, by the rows' names; the first row is the headline."""
    rows = {case["title"]: f"{numbers[case['headline']]:.2f}"}
    if "import" in numbers:
        rows["– import"] = f"{numbers['import']:.2f}"
    if "pairs" in numbers and len(case["pairs"]) <= len(SIZES):
        rows |= {f"– pair of {name}": f"{took:.2f}" for name, took in zip(case["pairs"], numbers["pairs"], strict=True)}
    elif "pairs" in numbers:
        rows["– first pair"] = f"{numbers['pairs'][0]:.2f}"
        rows["– each later pair (median)"] = f"{np.median(numbers['pairs'][1:]):.2f}"
    elif len(case.get("pairs", ())) > 1:
        rows["– each pair"] = f"{numbers['whole'] / len(case['pairs']):.2f}"
    if "found" in numbers:
        rows[f"– pairs within {FOUND_DEGREES:g}° of the truth"] = f"{numbers['found']:g} of {len(case['pairs'])}"
    return rows


def main(given: argparse.Namespace) -> None:
    from urrt_jax.data import find_data
    from urrt_jax.peers import PEERS

    data = Path(find_data(given.data))
    command = f"python experiments/benchmarks/first_use.py --data {data.name} --repeats {given.repeats}"
    importlib.import_module("urrt_jax.registration")  # loads our libraries once, as the next lines load Open3D
    missing = None
    try:
        PEERS["scan_ransac"].versions()
    except ImportError as error:
        # A loader's message may hold paths of this machine: only their last parts are kept.
        missing = " ".join(Path(word).name if "/" in word else word for word in str(error).split())
        _tell(f"Open3D is not measured: {missing}")
    cases = load(given.out)
    with tempfile.TemporaryDirectory() as folder:
        for name in given.only or CASES:
            try:
                case = CASES[name](Path(folder), data)
            except FileNotFoundError as error:
                _tell(f"{name}: not measured, {error}")
                continue
            cases[name] = measure(case, given.repeats, missing)
            save(given.out, cases, command)
    print(as_markdown({name: cases[name] for name in CASES if name in cases}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help=f"the folder with {SCANS}, or the file; by default $URRT_DATA")
    parser.add_argument("--only", nargs="+", choices=CASES, help="measure these anew, and keep the others' results")
    parser.add_argument("--repeats", type=int, default=3, help="how many processes find the cache filled")
    parser.add_argument("--out", type=Path, default=HERE, help="the folder to write first_use.json and first_use.md to")
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)  # the measured process itself
    given = parser.parse_args()
    if given.child:
        print("\n" + json.dumps(_child(*given.child)))
        sys.exit()
    if given.repeats < 1:
        parser.error(f"--repeats: expected at least 1, got {given.repeats}")
    main(given)
