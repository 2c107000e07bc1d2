"""results/claims.py and the intervals over seeds: hand-worked numbers, scipy, made-up runs."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
from scipy import stats

import results.claims as claims
import results.plot as plot
from results.claims import OPEN, REFUTED, SUPPORTED
from train import default_settings


def test_interquartile_mean_of_hand_worked_values():
    assert plot.iqm(np.array([9.0, 1, 2, -50])) == 1.5  # a quarter off at either end
    assert plot.iqm(np.array([1.0, 2, 6])) == 3  # of fewer than four none


def test_interval_of_two_seeds_is_what_lies_between_and_of_one_there_is_none():
    assert plot.over_seeds([1.0, 5.0]) == (3, 1, 5)
    middle, *interval = plot.over_seeds([4.0], [1.0, 2.0], signs=(1, -1))
    assert middle == 2.5 and np.isnan(interval).all()
    assert plot.over_seeds([1.0, 2, 6]) == (3, 1, 6)  # nor does it know more of three
    assert plot.over_seeds([0.0, 1, 2, 100])[0] == 1.5  # of the interquartile mean
    assert plot.shown((2.5, *interval)) == "2.5"


def test_interval_of_a_difference_is_that_of_all_resamples():
    """Of three seeds against three, by enumeration of all 27 × 27 pairs of resamples."""
    a, b = np.array([3.0, 7, 8]), np.array([1.0, 2, 4])
    found = plot.over_seeds(list(a), list(b), signs=(1, -1))
    means = [np.array([*itertools.product(x, repeat=3)]).mean(1) for x in (a, b)]
    every = np.subtract.outer(*means).ravel()
    assert found[0] == pytest.approx(a.mean() - b.mean())
    np.testing.assert_allclose(found[1:], np.quantile(every, [0.025, 0.975]), atol=0.35)


def test_score_is_the_mean_evaluation_of_the_last_fifth():
    steps = 5000.0 * np.arange(1, 21)
    run = {"env_steps": steps, "eval_return": np.arange(20.0), "coverage": np.arange(20.0)}
    assert plot.score(run, 100_000) == pytest.approx(np.mean([15, 16, 17, 18, 19]))
    assert plot.score(run, 50_000) == pytest.approx(
        np.mean([7, 7.5, 8, 8.5, 9])
    )  # 40,000 to 50,000
    assert plot.covered(run, 50_000) == np.mean(np.arange(10))
    late = run | {"env_steps": steps + 1}
    assert plot.covered(late, 50_000) == np.mean(np.arange(10))
    assert plot.score({k: v[:1] for k, v in run.items()}, 5000) == 0


@pytest.mark.parametrize("low, high, lies, expected", [
    (1, 9, "above", SUPPORTED), (-9, -1, "above", REFUTED), (-1, 1, "above", OPEN),
    (-4, 4, "within", SUPPORTED), (6, 9, "within", REFUTED), (-9, -6, "within", REFUTED),
    (-4, 9, "within", OPEN), (-99, 4, "not above", SUPPORTED), (6, 9, "not above", REFUTED),
    (4, 6, "not above", OPEN), (np.nan, np.nan, "above", OPEN), (np.nan, np.nan, "within", OPEN),
])  # fmt: skip
def test_verdicts_of_intervals_with_a_margin_of_five(low, high, lies, expected):
    assert claims.verdict(low, high, lies, 5) == expected


def made_up(**returns) -> dict:
    """{env: {label: {seed: run}}} of final returns by arm, in all four robots."""
    steps = np.array([50_000.0, 100_000.0])
    arms = {
        name.replace("_", "-"): {
            str(k): {"env_steps": steps, "eval_return": np.full(2, r), "coverage": np.full(2, r)}
            for k, r in enumerate(of)
        }
        for name, of in returns.items()
    }
    return {f"{robot}BulletEnv-v0": dict(arms) for robot in claims.ROBOTS}


def judged(runs: dict) -> list[str]:
    """The verdict on each claim."""
    reference = plot.read_reference()
    common = claims.shared_changes(runs)[0]
    return [claims.judge(groups, runs, common, reference)[0] for groups in claims.CLAIMS.values()]


def test_claims_of_made_up_runs():
    """All as the paper says but for Ant (3) and the majority (5), then all as it says of Ant: the
    same returns on all robots cannot be both."""
    runs = made_up(
        dreamer=[1.0, 2, 3], dreamer_maxent=[980.0, 985, 990], revised=[950.0, 960, 970],
        maxent=[990.0, 995, 999],
    )  # fmt: skip
    assert judged(runs)[:5] == [SUPPORTED, SUPPORTED, REFUTED, SUPPORTED, REFUTED]
    explored = made_up(
        dreamer=[500.0, 505, 510], dreamer_maxent=[980.0, 985, 990], revised=[505.0, 508, 512],
        maxent=[990.0, 995, 999],
    )  # fmt: skip
    assert judged(explored)[:5] == [REFUTED, OPEN, SUPPORTED, REFUTED, SUPPORTED]


def test_two_seeds_are_not_enough_and_what_is_missing_is_named(capsys):
    runs = made_up(dreamer=[1.0, 2], revised=[950.0, 960])
    assert set(judged(runs)) == {OPEN}
    text = claims.report(runs, plot.read_reference())
    assert "| no maxent |" in text and "| no dreamer-maxent |" in text
    assert "| Hopper | revised − dreamer: above 0 | 953.5 [948.0, 959.0] | 2, 2 | 100,000 |" in text


def test_a_seed_that_was_run_twice_is_one_seed():
    runs = made_up(dreamer=[1.0, 2, 3], revised=[950.0, 960, 970])
    assert f"| 3, 3 | 100,000 | {SUPPORTED} |" in claims.report(runs, plot.read_reference())
    for arms in runs.values():
        again = {f"{seed}, again": run for seed, run in arms["revised"].items() if seed == "0"}
        arms["revised"] = {"0": arms["revised"]["0"], "1": arms["revised"]["1"]} | again
    text = claims.report(runs, plot.read_reference())
    assert f"| 2, 3 | 100,000 | {OPEN} |" in text and "| 3, 3 |" not in text
    assert "| 953.0 [" in text  # (950 + 960) / 2 − 2


def test_runs_are_held_against_those_of_the_same_settings():
    """An arm run with other settings is no opponent; both with the same ones are."""
    runs = made_up(dreamer=[1.0, 2, 3], revised=[4.0, 5, 6])
    for arms in runs.values():
        arms["revised, batch_size 10"] = arms.pop("revised")
    assert claims.shared_changes(runs) == []
    said = claims.report(runs, plot.read_reference())
    assert "no revised" in said and "with these settings: revised, batch_size 10." in said
    assert "with these settings: dreamer" not in said and said.endswith(".\n")
    for arms in runs.values():
        arms["dreamer, batch_size 10"] = arms.pop("dreamer")
    assert claims.shared_changes(runs) == [{"batch_size 10"}]
    assert "Left out" not in claims.report(runs, plot.read_reference())


def test_a_change_that_an_arm_has_anyway_is_common_to_it_too():
    """With --no-q-critic `dreamer` stays `dreamer`: it has a V critic as it is."""
    runs = made_up(dreamer=[1.0, 2, 3], maxent=[7.0, 8, 9], revised=[4.0, 5, 6])
    for arms in runs.values():
        for arm in ("maxent", "revised"):
            arms[f"{arm}, q_critic False"] = arms.pop(arm)
    assert {"q_critic False"} in claims.shared_changes(runs)
    text = claims.report(runs, plot.read_reference())
    assert "| maxent − dreamer: above 0 | 6.0 [4.7, 7.3] | 3, 3 | 100,000 | supported |" in text


def test_a_comparison_is_made_where_all_of_its_runs_are():
    def run(returns):
        steps = np.array([5_000.0, 10_000, 100_000])[: len(returns)]
        return {"env_steps": steps, "eval_return": np.array(returns), "coverage": 0 * steps}

    arms = {
        "revised": {"0": run([10.0, 20, 30]), "1": run([10.0, 20]), "2": run([10.0, 20, 30])},
        "dreamer": {str(k): run([1.0, 2, 900]) for k in range(3)},
    }
    one = claims.above("Hopper", "revised", "dreamer")
    *_, steps, said = claims.compare(one, arms, frozenset(), plot.read_reference())
    assert (steps, said) == ("10,000", SUPPORTED)


def test_the_margin_is_a_tenth_of_what_the_best_arm_earns_above_random_actions():
    """Held against the best of the actions that look at nothing."""
    earn = {"random": 100, "zero": 150, "constant": 120}
    reference = {("HopperBulletEnv-v0", p): {"return": str(r)} for p, r in earn.items()}
    arms = made_up(dreamer=[155.0] * 3, maxent=[300.0] * 3)["HopperBulletEnv-v0"]
    one = claims.Comparison("Hopper", {"dreamer": 1, claims.BLIND: -1}, "not above")
    where, found, *_, said = claims.compare(one, arms, frozenset(), reference)
    assert (where, found, said) == ("not above 20", "5.0 [5.0, 5.0]", SUPPORTED)


def test_an_arm_that_stopped_early_has_no_part_in_the_margin():
    env = "HalfCheetahBulletEnv-v0"
    arms = made_up(maxent=[700.0, 710, 720], revised=[690.0, 700, 710], dreamer=[9000.0] * 3)[env]
    arms["dreamer"]["0"]["env_steps"] = arms["dreamer"]["0"]["env_steps"] / 4  # not all got as far
    one = claims.Comparison("HalfCheetah", {"revised": 1, "maxent": -1}, "within")
    assert claims.compare(one, arms, frozenset(), plot.read_reference())[0] == "within ±180"


@pytest.mark.parametrize("late_first", [True, False])
def test_an_arm_that_was_evaluated_later_has_no_part_in_the_margin(late_first):
    env = "HalfCheetahBulletEnv-v0"
    arms = made_up(maxent=[700.0, 710, 720], revised=[690.0, 700, 710])[env]
    late = made_up(dreamer=[-300.0] * 3)[env]
    for run in late["dreamer"].values():
        run["env_steps"] = np.array([150_000.0, 200_000])
    arms = late | arms if late_first else arms | late
    one = claims.Comparison("HalfCheetah", {"revised": 1, "maxent": -1}, "within")
    assert claims.compare(one, arms, frozenset(), plot.read_reference())[0] == "within ±180"


@pytest.mark.parametrize("returns, said", [
    ((9.0, 9, 9, 1), SUPPORTED), ((9.0, 9, 1, 1), REFUTED), ((9.0, 9, 9, None), SUPPORTED),
    ((9.0, 9, None, 1), OPEN), ((9.0, 9, None, None), OPEN),
])  # fmt: skip
def test_of_four_comparisons_three_must_hold(returns, said):
    """Each of `maxent` with 5; None: of a single seed."""
    runs = {}
    for robot, value in zip(claims.ROBOTS, returns, strict=True):
        of = [1.0] if value is None else [value] * 3
        env = f"{robot}BulletEnv-v0"
        runs[env] = made_up(maxent=of, revised=[5.0] * 3)[env]
    group = [(3, [claims.above(robot, "maxent", "revised") for robot in claims.ROBOTS])]
    assert claims.judge(group, runs, frozenset(), plot.read_reference())[0] == said


def test_claims_say_how_many_of_their_comparisons_must_hold():
    needs = [[(n, len(of)) for n, of in groups] for groups in claims.CLAIMS.values()]
    assert needs == [[(2, 2)], [(4, 4)], [(3, 3)], [(3, 3)], [(4, 4), (3, 4)], [(4, 4)]]


def test_the_claim_of_coverage_looks_at_coverage():
    runs = made_up(maxent=[7.0, 8, 9], revised=[1.0, 2, 3])
    assert judged(runs)[5] == SUPPORTED
    assert "Left out" not in claims.report(runs, plot.read_reference())
    for run in (run for arms in runs.values() for of in arms.values() for run in of.values()):
        run["coverage"] = -run["eval_return"]
    assert judged(runs)[5] == REFUTED


def test_coverage_is_compared_at_equal_noise():
    """Of `revised` without noise there is nothing to compare until `maxent` was run so too."""
    runs = made_up(maxent=[7.0, 8, 9], revised=[1.0, 2, 3])
    for arms in runs.values():
        arms["revised, action_noise 0.0"] = arms.pop("revised")
    assert "with these settings: revised, action_noise 0.0." in claims.report(
        runs, plot.read_reference()
    )
    for arms in runs.values():
        arms["maxent, action_noise 0.0"] = arms.pop("maxent")
    assert claims.shared_changes(runs) == [{"action_noise 0.0"}]
    assert judged(runs)[5] == SUPPORTED


def test_folders_are_judged_and_bad_ones_end_with_one_sentence(tmp_path, capsys):
    assert claims.main([str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    for seed in range(3):
        folder = tmp_path / f"run{seed}"
        folder.mkdir()
        settings = dataclasses.asdict(dataclasses.replace(default_settings("dreamer"), seed=seed))
        (folder / "settings.json").write_text(json.dumps(settings))
        columns = "env_steps,wall_seconds,eval_return,eval_interval95,eval_length,coverage"
        (folder / "metrics.csv").write_text(f"{columns}\n5000,60,{10 + seed},1,9,2.5\n")
    assert claims.main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "With the usual settings" in said and "| 5,000 | supported |" in said


def test_coverage_beside_the_entropy_estimate_is_a_line_a_run():
    """ρ is Spearman's, nan left out; nothing is drawn of runs without an estimate."""
    axes = plot.plt.figure().subplots()
    run = {"coverage": np.array([1.0, 2, 3, 9]), "mdn/entropy": np.array([5.0, 7, 6, np.nan])}
    plot.draw_against(axes, {"0": run}, "maxent", "C0")
    rho = stats.spearmanr([5, 7, 6], [1, 2, 3]).statistic
    assert [text for text in axes.get_legend_handles_labels()[1]] == [f"maxent: ρ {rho:.2f}"]
    assert axes.lines[0].get_ydata().tolist() == [1, 2, 3]
    plot.draw_against(axes, {"0": {"coverage": run["coverage"]}}, "revised", "C1")
    assert len(axes.get_legend_handles_labels()[1]) == 1
    plot.plt.close("all")
