"""The pages for readers: their tables are those that were written, their numbers those of the results. Reads files."""

import json
import re

import pytest

from experiments.pages import HERE, PAGES, refreshed
from experiments.summary import find_part, load, measured

PAGE = (HERE / "README.md").read_text()
TABLES = sorted(path.parent.name for path in HERE.glob("*/config.toml") if (path.parent / "table.md").exists())
TEXTS = {path.relative_to(HERE.parent).as_posix(): path.read_text() for path in PAGES}


@pytest.mark.parametrize("page", TEXTS)
def test_tables_of_a_page_are_those_that_were_written(page):
    """If this fails, run `python -m experiments.pages`."""
    assert refreshed(TEXTS[page]) == TEXTS[page]


def test_front_page_shows_the_short_table():
    assert "<!-- table: summary_short.md -->" in TEXTS["README.md"]


@pytest.mark.parametrize("pattern", ["summary_*.md", "benchmarks/*.md", "ablation/*.md", "trials/*.md"])
def test_pages_show_all_tables_of_a_kind(pattern):
    tables = [path.relative_to(HERE).as_posix() for path in HERE.glob(pattern) if path.name != "README.md"]
    assert tables and set(tables) <= set(
        re.findall(r"^<!-- table: (\S+) -->$", "\n".join(TEXTS.values()), re.MULTILINE)
    )


def test_a_table_takes_the_place_of_what_stood_between_its_marks():
    place = "before\n<!-- table: regions/table.md -->\nold\n<!-- end -->\nafter"
    table = (HERE / "regions/table.md").read_text().strip()
    assert refreshed(place) == f"before\n<!-- table: regions/table.md -->\n\n{table}\n\n<!-- end -->\nafter"


@pytest.mark.parametrize(
    "page",
    [
        "<!-- table: regions/table.md -->\n",
        "<!-- end -->",
        "<!-- table: regions/table.md -->\n<!-- table: regions/table.md -->\n<!-- end -->",
    ],
    ids=["no end", "no beginning", "two beginnings"],
)
def test_marks_without_counterpart_are_an_error(page):
    with pytest.raises(ValueError, match="beginning and an end"):
        refreshed(page)


@pytest.mark.parametrize("page", TEXTS)
def test_links_of_a_page_lead_to_files(page):
    folder = (HERE.parent / page).parent
    links = re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", TEXTS[page])
    missing = [link for link in links if "://" not in link and not (folder / link).exists()]
    assert not missing


def test_every_table_can_be_reached_from_the_page_of_results():
    written = {path.relative_to(HERE).as_posix() for path in HERE.glob("*/*.md") if path.name != "README.md"}
    assert written <= set(re.findall(r"\]\((\S+?\.md)\)", PAGE))


@pytest.mark.parametrize("name", TABLES)
def test_page_shows_the_command_of_every_table(name):
    """With the flags that the results record. Results from before `urrt reproduce` was renamed keep the old name."""
    flags = load(name)["command"].partition(" --data ")[2]
    assert f"`python -m experiments.reproduce {name.split('_')[0]} --data {flags}`" in PAGE


@pytest.mark.parametrize("name", ["ablation", "confidence", "trials"])
def test_page_shows_the_command_that_the_results_record(name):
    assert f"`{load(name)['command']}`" in PAGE


def _figure(experiment: str, protocol: str, method: str, name: str, place: int = 0) -> float:
    """A figure of a method; of the unsymmetric categories alone with the prefix "asymmetric."."""
    parts = [part for part in load(experiment)["parts"] if part["protocol"] == protocol]
    row = measured(parts[place])[method]
    return row["asymmetric"][name.removeprefix("asymmetric.")] if name.startswith("asymmetric.") else row[name]


def _noise(protocol: str, method: str, name: str) -> float:
    return _figure("table2_noise", protocol, method, name)


def _beyond(protocol: str, method: str, name: str, place: int = 0) -> float:
    return _figure("beyond", protocol, method, name, place)


def _best_of_peers(protocol: str, name: str) -> float:
    """The best figure of other methods on the pairs that hardly overlap."""
    peers = ("scan_icp", "scan_fgr", "scan_ransac", "scan_kiss")
    return max(_figure("default_call", protocol, peer, name, 1) for peer in peers)


def _lost(name: str) -> float:
    """The most that recall loses on categories that training never saw, in any protocol."""
    rows = [measured(part) for part in load("unseen")["parts"]]
    return max(each[name][RECALL] - each[f"{name}:modelnet40-unseen"][RECALL] for each in rows)


def _gains_in_the_grid() -> dict[str, float]:
    """How much higher the mean recall of a peer's best setting is, in the grid of settings, than of the one in use."""
    in_use = {
        row["title"]: set(map(str, row["identity"]["settings"].values()))
        for row in find_part(load("beyond"), "independent_noise")["rows"]
        if "settings" in row["identity"]
    }
    means: dict[str, dict[str, float]] = {}
    for row in load("peer_settings")["rows"]:
        values = [row[name] for name in ("dcp", "incomplete_both", "independent_noise", "outliers")]
        means.setdefault(row["peer"], {})[row["setting"]] = sum(values) / len(values)
    gains = {}
    for peer, found in means.items():
        (used,) = (setting for setting in found if set(re.findall(r"[\d.]+", setting)) <= in_use[peer])
        gains[peer] = max(found.values()) - found[used]
    return gains


RECALL = "recall_5deg_0.1"
_SPEED = {
    row["method"].split(" 0.20.0")[0]: row["milliseconds_a_pair"]
    for row in json.loads((HERE / "benchmarks/speed.json").read_text())["rows"]
}
_RANSAC = "scans: RANSAC (Open3D), then point-to-plane ICP"
_BATCHED = _SPEED["register, batches of 32"]
_HONEST = load("confidence")
_SIZES, _KINDS = _HONEST["by_points"], {row["pairs_of"]: row for row in _HONEST["by_kind"]}
_REGIONS, _PARTS = (load("regions")["numbers"][each] for each in ("places", "parts"))
_OFF = "degrees off by the regions' centroids, {}"
_PARTS_CARD = json.loads((HERE / "regions/parts.json").read_text())
_PAPERS_ICP = find_part(load("table3_comparison"), "dcp")["published"]["ICP (paper)"]


def _same(protocol: str) -> str:
    return f"{100 * _PARTS[f'consistency before alignment, {protocol}']:.0f}"


def _wrong(kind: str) -> str:
    row = _KINDS[kind]
    return f"{round(row['beyond_5'] * row['called'])} of the {row['called']}"


def _range(name: str, rows: list[dict], factor: float = 100) -> str:
    return f"{factor * min(row[name] for row in rows):.1f} to {factor * max(row[name] for row in rows):.1f}"


# What the pages say, word for word.
RESULTS = (
    f"ICP (MAE {_PAPERS_ICP[1]:.1f}°) is worse than doing nothing "
    f"({_figure('table3_comparison', 'dcp', 'identity', 'mae_rotation'):.1f}°); Open3D's ICP has "
    f"{_figure('table3_comparison', 'dcp', 'icp_identity', 'mae_rotation'):.1f}°",
    f"within 1° on {_figure('table3_comparison', 'dcp', 'plain', 'recall_1deg'):.3f} of the clean pairs",
    f"the mean error is {_noise('outliers share=0.2', 'plain', 'asymmetric.angle_mean'):.4f}° without",
    f"{_noise('drift', 'plain', 'angle_mean'):.2f}° for P.D. and "
    f"{_noise('outliers', 'plain', 'angle_mean'):.2f}° for D.O.",
    f"RANSAC with ICP has {_noise('drift', 'ransac_icp', 'angle_mean'):.2f}° and "
    f"{_noise('outliers', 'ransac_icp', 'angle_mean'):.2f}°",
    f"`register` finds {_noise('incomplete_both', 'plain', RECALL):.3f} of the pairs**, RANSAC with ICP "
    f"{_noise('incomplete_both', 'ransac_icp', RECALL):.3f}.",
    f"MAE(R) is {_noise('incomplete_both', 'plain', 'mae_rotation'):.3f}°, that of RANSAC with ICP "
    f"{_noise('incomplete_both', 'ransac_icp', 'mae_rotation'):.2f}°",
    f"MAE(t) is {_noise('incomplete_both', 'plain', 'mae_translation'):.4f} against "
    f"{_noise('incomplete_both', 'ransac_icp', 'mae_translation'):.4f}",
    f"`register` finds {_noise('incomplete_both', 'plain', RECALL):.3f} of the pairs, RANSAC "
    f"{_noise('incomplete_both', 'ransac', RECALL):.3f}.",
    f"within 5° on {_beyond('independent_noise', 'plain', RECALL):.3f} of the pairs, ICP on "
    f"{_beyond('independent_noise', 'icp', RECALL):.3f}",
    f"within 5° on {_beyond('independent_noise', 'plain', 'asymmetric.' + RECALL):.3f}. ",
    f"ICP from 32 rotations finds {_beyond('independent_noise', 'icp_starts', RECALL, 1):.3f} with a mean error of "
    f"{_beyond('independent_noise', 'icp_starts', 'angle_mean', 1):.1f}°, and `register` finds "
    f"{_beyond('independent_noise', 'plain', RECALL, 1):.3f} with "
    f"{_beyond('independent_noise', 'plain', 'angle_mean', 1):.1f}°",
    f"MAE(R) is {_beyond('prnet', 'plain', 'mae_rotation'):.3f}°, and "
    f"{_beyond('prnet_noise', 'plain', 'mae_rotation'):.3f}° with noise",
    f"without a search {_beyond('rpmnet', 'plain', RECALL):.3f} are found, by the default call "
    f"{_figure('default_call', 'rpmnet', 'register', RECALL):.3f}, and with `search=Search(max_angle=90)` "
    f"{_beyond('rpmnet', 'search', RECALL):.3f}. RANSAC with ICP finds {_beyond('rpmnet', 'ransac_icp', RECALL):.3f}",
    f"the median error is {_beyond('rpmnet', 'search', 'angle_median'):.2f}° and the mean "
    f"{_beyond('rpmnet', 'search', 'angle_mean'):.2f}° "
    f"({_beyond('rpmnet', 'search', 'asymmetric.angle_mean'):.2f}° without",
    f"`register` has a mean of {_beyond('rpmnet', 'search_near', 'angle_mean'):.2f}°, or "
    f"{_beyond('rpmnet', 'search_near', 'asymmetric.angle_mean'):.2f}° without",
    f"it finds {_figure('default_call', 'independent_noise', 'register', RECALL):.3f} in the place of "
    f"{_figure('default_call', 'independent_noise', 'plain', RECALL):.3f}",
    f"within 1° on {_figure('unseen', 'dcp', 'network:modelnet40-unseen', 'recall_1deg'):.3f}, and so it is",
    f"at most {_lost('network'):.3f} of the pairs for the network alone, and {_lost('plain'):.3f} with refinement",
    f"Without a search `register` finds {100 * _beyond('scans', 'plain', 'recall_5deg_0.05'):.0f} % of the pairs",
    f"finds {_beyond('scans', 'plain', 'recall_2deg_0.02'):.3f} of the scans within 2° in the table above, and "
    f"{_figure('default_call', 'scans', 'plain', 'recall_2deg_0.02'):.3f} in the later",
    f"The default call finds {_figure('default_call', 'scans', 'register', 'recall_5deg_0.05', 1):.3f} of them, "
    f"and the best peer {_best_of_peers('scans', 'recall_5deg_0.05'):.3f}",
    f"{_range('beyond_5', _SIZES)} % are more than 5° wrong",
    f"{_range('beyond_45', [row for row in _SIZES if row['pairs_of'] != '4096 points'])} % are more than 45° wrong",
    f"at least {int(100 * min(row['right_asymmetric_called'] for row in _SIZES[3:]))} % of the right poses",
    f"of solids without any symmetry, {100 * min(row['right_solids_called'] for row in _SIZES[3:]):.0f} %",
    f"{100 * (1 - _SIZES[1]['right_called']):.1f} % of them at 64 points",
    f"of those of solids {100 * (1 - _SIZES[1]['right_solids_called']):.0f} %",
    f"the mean of eᵀC⁻¹e/6 is {_range('mean', _HONEST['covariance'], 1)}",
    f"{_wrong('RPM-Net crops, any rotation')} poses called converged are wrong",
    f"{_wrong('views of solids, any rotation').replace('the ', '')} for views of solids",
    f"{100 * _KINDS['RPM-Net crops, any rotation']['right']:.0f} % of RPM-Net's crops of 32 to 512 points",
    f"{_SPEED['FGR + ICP (Open3D)'] / _BATCHED:.1f} times as fast as FGR with ICP",
    f"{_BATCHED / _SPEED['ICP from the centroids (Open3D)']:.1f} times as fast as `register` in batches",
    f"takes {_SPEED['scans of 40,000 points: register with search'] / _SPEED[_RANSAC]:.1f} times as long as RANSAC",
    f"of corresponding points, {100 * _REGIONS['consistency in the last step, clean']:.0f} % have the same region once "
    f"the clouds are nearly aligned, but only {100 * _REGIONS['consistency before alignment, clean']:.0f} % before, "
    f"and {100 * _REGIONS['consistency before alignment, D.I. two-sided']:.0f} % where both clouds are cropped",
    f"{_REGIONS['regions with more than 1 % of all points']:.0f} of the 8 regions hold more than 1 %",
    f"of clean pairs {_same('clean')} % have the same region before anything is aligned, of independent samples with "
    f"noise {_same('independent + noise')} %",
    f"of pairs that are both cropped it is {_same('D.I. two-sided')} %",
    f"align clean pairs, with a mean error of {_PARTS[_OFF.format('clean, mean')]:.3f}°, where those of places are off "
    f"by {_REGIONS[_OFF.format('clean, mean')]:.1f}°",
    f"with noise the median is {_PARTS[_OFF.format('P.D., median')]:.1f}°",
    f"trained for {_PARTS_CARD['seconds'] / 60:.0f} minutes from the packaged ones: `{_PARTS_CARD['command']}`",
    f"by at most {max(_gains_in_the_grid().values()):.3f}",
    f"{len(load('trials')['rows'])} changes of the network",
)


@pytest.mark.parametrize("statement", RESULTS)
def test_page_says_what_was_measured(statement):
    assert statement in " ".join(PAGE.split())


def test_page_of_benchmarks_says_how_much_longer_jaxkd_takes():
    rows = [row["milliseconds"] for row in json.loads((HERE / "benchmarks/neighbors.json").read_text())["rows"]]
    ratios = [row["jaxkd"] / min(row.get("point by point", 1e9), row["blocks"]) for row in rows if "jaxkd" in row]
    assert f"{min(ratios):.0f} to {max(ratios):.0f} times as long" in TEXTS["experiments/benchmarks/README.md"]


def test_page_of_benchmarks_says_which_goals_are_missed():
    cases = json.loads((HERE / "benchmarks/first_use.json").read_text())["cases"]
    over = {
        cache: {name: case[cache][case["headline"]] / case["asked"][cache] for name, case in cases.items()}
        for cache in ("empty", "filled")
    }
    assert [name for name, share in over["empty"].items() if share <= 1] == ["help"]
    least, most = (100 * (pick(over["filled"].values()) - 1) for pick in (min, max))
    assert least > 0
    assert f"all goals are missed, by {least:.0f} to {most:.0f} %" in TEXTS["experiments/benchmarks/README.md"]
    each = cases["folder"]["filled"]["whole"] / len(cases["folder"]["pairs"])
    assert f"takes {each:.2f} s, reading" in " ".join(TEXTS["experiments/benchmarks/README.md"].split())


def test_only_one_peer_has_the_setting_that_is_best_in_the_grid():
    assert [peer for peer, gain in _gains_in_the_grid().items() if gain == 0] == ["KISS-Matcher"]
