"""The page of learned methods: what it says is what was measured, and networks give what their authors' code gave."""

import json

import pytest

from experiments.summary import HERE, find_part, load, measured

PAGE = " ".join((HERE / "learned" / "README.md").read_text().split())
RESULTS = load("learned")
PARITY = json.loads((HERE / "learned" / "parity.json").read_text())["rows"]
WITH_COUNTERPARTS = ("dcp", "incomplete", "incomplete_both", "outliers", "prnet")
LACKING = ("incomplete", "incomplete_both", "rpmnet")
OURS = ("network", "plain", "register")


def _recall(protocol: str, method: str) -> float:
    return measured(find_part(RESULTS, protocol))[method]["recall_5deg_0.1"]


def _mae(protocol: str, method: str) -> float:
    return measured(find_part(RESULTS, protocol))[method]["mae_rotation"]


def _here(name: str) -> str:
    """The row of a network that was trained here."""
    return f"{name}:experiments/learned/weights/{name}.npz"


def _mse(method: str) -> float:
    return measured(find_part(RESULTS, "dcp"))[method]["mse_rotation"]


def _least(method: str) -> float:
    return min(measured(part)[method]["recall_5deg_0.1"] for part in RESULTS["parts"])


(TRAINED,) = (part for part in load("table3_comparison")["parts"] if part["title"].endswith("learned methods"))
PAPER = {name.removesuffix(" (paper)"): values for name, values in TRAINED["published"].items()}


def _clean(name: str, value: str = "mae_rotation") -> float:
    """Of the clean pairs of table 3, where ``NAME:`` stands for the weights that were trained here."""
    weights = _here(name[:-1]) if name.endswith(":") else name
    return measured(TRAINED)[weights][value]


COSTS = {
    row["name"]: row["milliseconds_a_pair"]
    for row in json.loads((HERE / "benchmarks" / "networks.json").read_text())["rows"]
}


def _cost(*names: str) -> str:
    """What a pair takes, or the least and the most of several methods, in whole milliseconds."""
    least, most = (f"{pick(COSTS[name] for name in names):.0f}" for pick in (min, max))
    return least if least == most else f"{least} to {most}"


def _rienet(protocol: str, here: bool) -> float:
    """The share of pairs of table 2 that RIENet finds, trained here or with released weights."""
    parts = [part for part in load("table2_noise")["parts"] if part["title"].endswith("learned methods")]
    name = _here("rienet") if here else "rienet"
    return measured(find_part({"parts": parts}, protocol))[name]["recall_5deg_0.1"]


_COORDINATES = [_clean(f"{name}:") for name in ("dcp_v1", "dcp_v2", "prnet", "pointnetlk", "pointnetlk_revisited")]
_LK = ("pointnetlk", "pointnetlk_revisited")
STATEMENTS = (
    f"it finds {_recall('incomplete_both', 'rienet'):.2f} of the pairs, as many as `register`",
    f"{_recall('drift', 'rienet'):.2f} of the pairs with noise (P.D.), and "
    f"{_recall('independent', 'rienet'):.2f} of the independent samples",
    f"There it finds {_recall('dcp', 'dcp_v1'):.2f} of the pairs",
    f"MAE(R) is {_mae('drift', 'dcp_v1'):.1f}° under noise, {_mae('incomplete', 'dcp_v1'):.1f}° where the source is "
    f"cropped and {_mae('outliers', 'dcp_v1'):.1f}° with outliers",
    f"({_recall('independent', _LK[0]):.2f} and {_recall('dcp', _LK[0]):.2f}; Revisited "
    f"{_recall('independent', _LK[1]):.2f} and {_recall('dcp', _LK[1]):.2f})",
    "at most {:.2f} of the pairs of D.I. and D.O.".format(
        max(_recall(protocol, name) for protocol in ("incomplete", "incomplete_both", "outliers") for name in _LK)
    ),
    f"at least {_least('network'):.2f}. Refined, it finds at least {_least('plain'):.2f}. RANSAC with ICP finds "
    f"at least {_least('ransac_icp'):.2f}",
    f"a pair takes {_cost('register')} ms with `register`, {_cost('dcp_v1', *_LK)} ms with DCPv1 or PointNetLK, "
    f"{_cost('deepgmr')} ms with DeepGMR, {_cost('rienet')} ms with RIENet, and "
    f"{_cost('dcp_v2', 'rpmnet', 'prnet')} ms with DCPv2, RPM-Net or PRNet",
    f"as fast as ICP ({_cost('icp')} ms)",
    f"slower than FGR with ICP ({_cost('fgr_icp')} ms)",
    f"({_mse('dcp_v1'):.1f} and {_mse('pointnetlk'):.1f})",
    f"it finds {_recall('dcp', _here('rpmnet')):.2f} of the clean pairs, "
    f"{_recall('drift', _here('rpmnet')):.2f} with noise (P.D.), "
    f"{_recall('outliers', _here('rpmnet')):.2f} with outliers and "
    f"{_recall('independent', _here('rpmnet')):.2f} of the independent samples, "
    f"but at most {max(_recall(each, _here('rpmnet')) for each in LACKING):.2f} where a cloud lacks a part",
    f"there it finds {_recall('dcp', _here('deepgmr')):.2f} of them, elsewhere at most "
    f"{max(_recall(each['protocol'], _here('deepgmr')) for each in RESULTS['parts'] if each['protocol'] != 'dcp'):.2f}",
    f"trained here it finds {_recall('drift', _here('rienet')):.2f} of P.D., and "
    f"{_recall('independent', _here('rienet')):.2f} of the independent samples",
    f"MAE(R) of {_clean('rienet:'):.3f}° and {_clean('deepgmr:'):.3f}°, RPM-Net {_clean('rpmnet:'):.2f}°",
    f"trained here it finds {_rienet('drift', True):.2f} of the pairs, the released weights, which never saw noise, "
    f"{_rienet('drift', False):.2f}",
    f"After so short a training on D.O. it finds {_rienet('outliers', True):.2f}, they find "
    f"{_rienet('outliers', False):.2f}",
    f"are still at {min(_COORDINATES):.1f}° to {max(_COORDINATES):.1f}°",
    f"behind both DCPs and RPM-Net (MAE(R) {PAPER['DeepGMR'][1]:.3f}°)",
    f"has a MAE(R) of {_clean('rpmnet:'):.3f}°, DCPv1's released weights {_clean('dcp_v1'):.3f}°",
    f"DCPv1 is better ({_clean('dcp_v1', 'mse_rotation'):.1f} and {_clean('rpmnet:', 'mse_rotation'):.1f})",
)


def test_rienet_finds_as_many_pairs_that_are_both_cropped_as_register():
    assert _recall("incomplete_both", "rienet") == _recall("incomplete_both", "register")


@pytest.mark.parametrize("statement", STATEMENTS)
def test_page_says_what_was_measured(statement):
    assert statement in PAGE


def test_deepgmr_trained_here_is_before_those_that_the_paper_has_before_it():
    before = ("DCPv1", "DCPv2", "RPM-Net")
    assert all(PAPER["DeepGMR"][place] > PAPER[name][place] for name in before for place in (0, 1))
    for value in ("mse_rotation", "mae_rotation"):
        assert _clean("deepgmr:", value) < min(
            _clean(name, value) for name in ("dcp_v1", "dcp_v1:", "dcp_v2:", "rpmnet:", "prnet:")
        )


@pytest.mark.parametrize("method", ["rienet", "ransac_icp"])
def test_methods_that_find_every_pair_with_counterparts(method):
    assert {_recall(protocol, method) for protocol in WITH_COUNTERPARTS} == {1.0}


def test_only_ours_finds_most_pairs_of_every_protocol():
    names = measured(RESULTS["parts"][0])
    assert [name for name in names if _least(name) >= 0.75] == list(OURS)
    assert [name for name in names if _least(name) >= 0.65] == ["ransac_icp", *OURS]


def test_networks_as_fast_as_classical_methods():
    networks = {name: time for name, time in COSTS.items() if name not in ("icp", "fgr_icp")}
    assert min(networks.values()) > COSTS["icp"]
    slow = {name for name, time in networks.items() if time > COSTS["fgr_icp"]}
    assert slow == {"rienet", "dcp_v2", "rpmnet", "prnet"}


def _apart(row: dict) -> float:
    """By what share MSE(R) or MAE(R) differ from the authors' code, the larger one; 0 beyond the digits on record."""
    gaps = []
    for name, digit in (("mse_rotation", 1e-4), ("mae_rotation", 1e-5)):
        here, authors = row["here"][name], row["authors"][name]
        gaps.append(0.0 if abs(here - authors) < digit else abs(here - authors) / authors)
    return max(gaps)


OTHER_PAIRS = ("outliers", "independent")
SAME = [row for row in PARITY if row["protocol"] not in OTHER_PAIRS]


def test_rows_that_agree_with_the_authors_code():
    agree = [row for row in PARITY if _apart(row) <= 0.02]
    assert f"**{len(agree)} of the {len(PARITY)} rows agree within 2 %" in PAGE
    assert {row["protocol"] for row in agree} == {"dcp", "drift", "prnet", "prnet signs=3", "incomplete"}
    assert all(row in agree for row in PARITY if row["protocol"] == "dcp")
    assert sum(row not in agree for row in PARITY if row["protocol"] in ("drift", "prnet", "prnet signs=3")) == 2


def test_rows_that_disagree_are_of_networks_that_fail():
    apart = [row for row in SAME if _apart(row) > 0.02]
    gaps = {
        name: max(abs(row["here"][name] / row["authors"][name] - 1) for row in apart)
        for name in ("mse_rotation", "mae_rotation")
    }
    assert f"by at most {100 * gaps['mae_rotation']:.1f} %, and MSE(R)" in PAGE
    assert f"by at most {100 * gaps['mse_rotation']:.1f} %. Those" in PAGE
    assert min(row["authors"]["mae_rotation"] for row in apart) > 20
