"""The plan of a fleet and the simulated node, compared with closed forms; the measurement fills all costs."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.bench.results import Results
from splatbot.bench.sizing import BENCHMARK, SizingSettings
from splatbot.bench.sizing.costs import KINDS, PLACE, Costs, RequestCost
from splatbot.bench.sizing.fleet import Fleet, most_robots, plan_fleet, utilisation
from splatbot.bench.sizing.measuring import plans_around_the_wall, wall
from splatbot.bench.sizing.queueing import RequestStream, simulate_node
from splatbot.collision import GaussianCollisionField
from splatbot.errors import FormatError, InputError
from splatbot.geometry import pose_from_quat
from splatbot.planning import GaussianRRTStar, PlanStatus
from splatbot.robots.panda import panda

# 10 ms of a core, 1 kB in and 2 kB out for each kind
COSTS = Costs(
    requests={kind: RequestCost(0.01, 1e3, 2e3) for kind in (*KINDS, PLACE)},
    place_tiles=5e6,
    place_fields=10e6,
    disk_each=150.0,
    shared_process=0.5e9,
    live_process=0.5e9,
    live_map=20e6,
)
FLEET = Fleet(
    gaussians=1e8,
    robots=1000.0,
    rates={"frame": 1.0, "collisions": 2.0, "distance": 2.0, "plan": 0.5, PLACE: 0.1},
    cores=20,
    memory=64e9,
    disk=1e12,
    read=1e9,
    link=1e9,
    balancer=2e9,
    load=0.5,
    shard=2e7,
)


def erlang_c(load: float, servers: int) -> float:
    """Return the probability that an arrival waits in an M/M/c queue of a load [Erlang] (Erlang 1917)."""
    below = sum(load**k / math.factorial(k) for k in range(servers))
    full = load**servers / math.factorial(servers) * servers / (servers - load)
    return full / (below + full)


@pytest.mark.parametrize(("servers", "share"), [(1, 0.5), (1, 0.8), (4, 0.7), (16, 0.9)])
def test_waits_of_a_simulated_node_are_those_of_the_closed_form_of_mmc(servers: int, share: float) -> None:
    service = 0.02
    rate = share * servers / service
    found = simulate_node([RequestStream(rate, service)], servers, 400_000)
    waits, delay = erlang_c(share * servers, servers), servers / service - rate
    np.testing.assert_allclose((found.wait > 1e-12).mean(), waits, atol=0.02)
    np.testing.assert_allclose(found.wait.mean(), waits / delay, rtol=0.1)
    np.testing.assert_allclose(found.latency.mean(), waits / delay + service, rtol=0.05)
    # P(wait > t) = C exp(-(c mu - lambda) t)
    tail = 1.0 / delay
    np.testing.assert_allclose((found.wait > tail).mean(), waits * math.exp(-1.0), atol=0.02)
    np.testing.assert_allclose(found.busy, share, rtol=0.02)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_the_link_waits_as_the_closed_form_of_md1(share: float) -> None:
    transfer = 0.001
    found = simulate_node([RequestStream(share / transfer, 1e-9, received=transfer)], 64, 300_000)
    wait = share * transfer / (2.0 * (1.0 - share))  # Pollaczek and Khinchine, for equal times
    np.testing.assert_allclose(found.latency.mean(), transfer + wait, rtol=0.05)


def test_streams_keep_their_shares_and_their_own_times() -> None:
    streams = [RequestStream(300.0, 0.001, 0.0, 0.0005), RequestStream(100.0, 0.01)]
    found = simulate_node(streams, 50, 100_000)
    np.testing.assert_allclose((found.kind == 0).mean(), 0.75, atol=0.01)
    np.testing.assert_allclose(found.latency[found.kind == 1].mean(), 0.01, rtol=0.1)
    assert found.latency[found.kind == 0].min() >= 0.0005


def test_utilisation_is_demand_over_capacity() -> None:
    plan = replace(plan_fleet(COSTS, FLEET), nodes=10)
    use = utilisation(COSTS, FLEET, plan, 1000.0)
    requests = 1000 * 5.6
    assert use["CPU"] == pytest.approx(requests * 0.01 / (10 * 20))
    assert use["link in"] == pytest.approx(requests * 8e3 / (10 * 1e9))
    assert use["link out"] == pytest.approx(requests * 16e3 / (10 * 1e9))
    assert use["balancer out"] == pytest.approx(requests * 16e3 / 2e9)
    assert use["disk"] == pytest.approx(2 * 1e8 * 150 / (10 * 1e12))
    assert use["disk reads"] == pytest.approx(1000 * 0.1 * 5e6 / (10 * 1e9))
    processes = (plan.shared_processes + plan.live_processes) * 0.5e9 + plan.shared_processes * 2 * plan.tiles
    assert use["memory"] == pytest.approx((processes + 1000 * 20e6) / (10 * 64e9))
    assert use["processes of the shared map"] == pytest.approx(1000 * 4.1 * 0.01 / plan.shared_processes)
    assert use["processes of live maps"] == pytest.approx(1000 * 1.5 * 0.01 / plan.live_processes)


def test_a_plan_keeps_every_process_and_node_within_its_share() -> None:
    plan = plan_fleet(COSTS, FLEET)
    assert plan.shards == 5
    assert 1000 * 4.1 * 0.01 / (plan.shards * plan.replicas) <= FLEET.load
    assert 1000 * 1.5 * 0.01 / plan.live_processes <= FLEET.load
    use = utilisation(COSTS, FLEET, plan, FLEET.robots)
    assert max(share for name, share in use.items() if "balancer" not in name) <= FLEET.load
    less = utilisation(COSTS, FLEET, replace(plan, nodes=plan.nodes - 1), FLEET.robots)
    assert max(share for name, share in less.items() if "balancer" not in name) > FLEET.load
    assert max(use["balancer in"], use["balancer out"]) <= FLEET.load
    assert plan.tiles == pytest.approx(math.ceil(1000 / (plan.shards * plan.replicas)) * 10e6)


def test_few_robots_still_have_two_processes_of_each_shard_on_two_nodes() -> None:
    plan = plan_fleet(COSTS, replace(FLEET, robots=1.0))
    assert (plan.shards, plan.replicas, plan.nodes) == (5, 2, 2)


@pytest.mark.parametrize(
    ("fleet", "first"),
    [
        (FLEET, "processes of live maps"),
        (replace(FLEET, rates={**FLEET.rates, "frame": 0.0, "plan": 0.0}), "processes of the shared map"),
        (replace(FLEET, cores=5), "CPU"),
        (replace(FLEET, link=1e7), "link out"),
        (replace(FLEET, balancer=1e7), "balancer out"),
        (replace(FLEET, memory=7e9, cores=400), "memory"),
        (replace(FLEET, read=1e5), "disk reads"),
    ],
)
def test_the_first_resource_that_is_full_is_the_one_made_scarce(fleet: Fleet, first: str) -> None:
    plan = replace(plan_fleet(COSTS, replace(fleet, load=0.9)), nodes=10, balancers=1)
    most = most_robots(COSTS, fleet, plan)
    assert min(most, key=lambda name: most[name]) == first
    assert utilisation(COSTS, fleet, plan, most[first])[first] <= 1.0 + 1e-9
    assert utilisation(COSTS, fleet, plan, 1.05 * most[first])[first] > 1.0
    assert most["disk"] == math.inf


@pytest.mark.parametrize(("frame", "robots"), [(0.093, 1), (0.05, 2), (0.01, 11)])
def test_a_process_serves_whole_robots_within_its_share(frame: float, robots: int) -> None:
    """Frames of 93 ms at 5 Hz use 46.5 % of a process, of which 60 % are allowed: one robot a process."""
    costs = replace(COSTS, requests={**COSTS.requests, "frame": RequestCost(frame, 1e3, 2e3)})
    fleet = replace(FLEET, load=0.6, rates=dict.fromkeys(FLEET.rates, 0.0) | {"frame": 5.0})
    plan = plan_fleet(costs, fleet)
    assert plan.live_processes == math.ceil(1000 / robots)
    # the robots that processes hold until one more robot would exceed the core of one
    assert most_robots(costs, fleet, plan)["processes of live maps"] == plan.live_processes * int(1 / (5 * frame))


@pytest.mark.parametrize(
    ("kind", "rate", "field"),
    [("frame", 12.0, "--frame-rate"), ("plan", 12.0, "--plan-rate"), ("distance", 12.0, "--query-rate")],
)
def test_a_robot_that_exceeds_a_process_is_refused(kind: str, rate: float, field: str) -> None:
    costs = replace(COSTS, requests=dict.fromkeys(COSTS.requests, RequestCost(0.093, 1e3, 2e3)))
    with pytest.raises(InputError, match="a process") as refused:
        plan_fleet(costs, replace(FLEET, rates=dict.fromkeys(FLEET.rates, 0.0) | {kind: rate}))
    assert refused.value.field == field


def test_both_caches_of_a_process_fit_and_places_without_queries_take_nothing() -> None:
    plan = plan_fleet(COSTS, FLEET)
    assert plan.tiles == math.ceil(1000 / plan.shared_processes) * 10e6
    with pytest.raises(InputError, match="too small for a process"):
        plan_fleet(COSTS, replace(FLEET, memory=(0.5e9 + 2 * plan.tiles - 1e3) / FLEET.load))
    idle = {**FLEET.rates, "collisions": 0.0, "distance": 0.0, PLACE: 0.0}
    without = plan_fleet(COSTS, replace(FLEET, rates=idle))
    assert (without.tiles, without.replicas) == (0.0, 2)


def test_requests_that_cost_nothing_need_one_process() -> None:
    costs = replace(COSTS, requests=dict.fromkeys(COSTS.requests, RequestCost(0.0, 0.0, 0.0)))
    plan = plan_fleet(costs, FLEET)
    assert (plan.replicas, plan.live_processes, plan.balancers) == (2, 1, 1)
    assert set(most_robots(costs, FLEET, plan)) == set(utilisation(costs, FLEET, plan, 1000.0))
    nothing = plan_fleet(costs, replace(FLEET, rates=dict.fromkeys(FLEET.rates, 0.0) | {"collisions": 1.0}))
    assert nothing.live_processes == 0


def test_the_measured_plans_search_until_their_budget_ends() -> None:
    field = GaussianCollisionField(wall())
    for body in plans_around_the_wall(4):
        base = pose_from_quat(body["base"]["translation"], body["base"]["quaternion_wxyz"])
        planner = GaussianRRTStar(field, panda(), T_world_base=base)
        found = planner.plan(body["start"], body["goal"], budget_ms=body["budget_ms"])
        assert found.status in (PlanStatus.SUCCESS, PlanStatus.TIMED_OUT)
        assert found.seconds > 0.9e-3 * body["budget_ms"]


def test_a_node_too_small_for_a_process_is_refused() -> None:
    with pytest.raises(InputError, match="too small for a process"):
        plan_fleet(COSTS, replace(FLEET, memory=0.5e9))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"link": "10"}, "--link"),
        ({"balancer": "0Gb"}, "--balancer"),
        ({"robots": 0.0}, "--robots"),
        ({"load": 1.0}, "--load"),
        ({"shard": 1e8}, "--shard"),
        ({"query_rate": math.nan}, "--query-rate"),
        ({"query_rate": 0.0, "plan_rate": 0.0, "frame_rate": 0.0}, "--query-rate"),
    ],
)
def test_settings_out_of_range_are_refused(values: dict[str, object], field: str) -> None:
    with pytest.raises(InputError) as refused:
        SizingSettings(**values).validate()  # type: ignore[arg-type]
    assert refused.value.field == field


def saved_costs(folder: Path, costs: Costs = COSTS) -> Path:
    """Write costs as those of another machine."""
    peaks = {"isa": "v3", "fma_peak_gflops": {"v3": {"1": 9.0}}}
    results = Results({"cpu": "a node", "cpus": 64, "load_1min": 0.1, **peaks})
    results.add("frame", "latency p50", 8.0, "ms")
    results.add("Gaussian", "memory", 223.0, "byte")
    costs.add_to(results)
    results.write_json(folder / "sizing.json")
    return folder / "sizing.json"


def test_a_plan_from_saved_costs_keeps_the_measurement_and_its_machine(tmp_path: Path) -> None:
    file = saved_costs(tmp_path)
    given = json.loads(file.read_text())
    for gaussians, shards in ((1e9, 50), (2e9, 100)):
        settings = SizingSettings(out=tmp_path, costs=file, robots=1000.0, gaussians=gaussians, simulated=5000)
        results = BENCHMARK.run(settings)
        assert results.find("plan: fleet", "shards") == shards
        assert [row.note for row in results.rows if row.metric == "saturates first"] == ["processes of live maps"]
        assert (results.find("simulated node: all", "latency p99") or 0) > 10.0
        written = json.loads(file.read_text())
        assert written["machine"] == given["machine"]
        assert [row for row in written["rows"] if not row["case"].startswith(("plan:", "simulated"))] == given["rows"]
    assert (tmp_path / "sizing.png").stat().st_size > 10_000


def test_a_plan_that_is_refused_leaves_the_measurement_as_it_is(tmp_path: Path) -> None:
    file = saved_costs(tmp_path)
    before = file.read_bytes()
    with pytest.raises(InputError, match="too small"):
        BENCHMARK.run(SizingSettings(out=tmp_path, costs=file, memory=0.5))
    assert file.read_bytes() == before


def test_costs_of_zero_are_planned_and_plotted(tmp_path: Path) -> None:
    free = RequestCost(0.0, 0.0, 0.0)
    file = saved_costs(tmp_path, Costs(dict.fromkeys(COSTS.requests, free), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    settings = SizingSettings(out=tmp_path, costs=file, query_rate=0.0, frame_rate=0.0, simulated=2000)
    results = BENCHMARK.run(settings)
    assert results.find("simulated process of live maps: plan", "latency p50") == 0.0


def test_the_simulated_process_serves_whole_robots(tmp_path: Path) -> None:
    """A robot that pushes 30 frames of 10 ms a second uses 30 % of a process."""
    settings = SizingSettings(
        out=tmp_path, costs=saved_costs(tmp_path), robots=100.0, frame_rate=30.0, plan_rate=0.0, simulated=50_000
    )
    results = BENCHMARK.run(settings)
    assert results.find("plan: fleet", "processes of live maps") == 50
    assert results.find("simulated process of live maps: all", "requests/s") == 60.0


@pytest.mark.parametrize("text", ["", "[]", '{"rows": [{"case": "frame"}]}', '{"rows": []}'])
def test_a_file_without_costs_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "sizing.json"
    file.write_text(text)
    with pytest.raises(FormatError) as refused:
        BENCHMARK.run(SizingSettings(out=tmp_path, costs=file))
    assert refused.value.file == str(file)


@pytest.mark.long
@pytest.mark.alone
def test_the_costs_of_two_services_are_measured(tmp_path: Path) -> None:
    results = BENCHMARK.run(SizingSettings(out=tmp_path, quick=True))
    for kind in (*KINDS, PLACE):
        assert (results.find(kind, "latency p50") or 0) > 0.1, kind
        assert (results.find(kind, "request") or 0) > 0.01, kind
    assert (results.find("frame", "request") or 0) > 160 * 120 * (
        3 + 4
    ) / 1e3  # colour and depth, and the rest of the body
    assert (results.find("frame", "answer") or 0) > 0.1
    assert 76.0 + 56.0 < (results.find("Gaussian", "memory") or 0) < 1000.0
    assert 76.0 < (results.find("Gaussian", "disk") or 0) < 250.0
    assert (results.find("process of the shared map", "memory") or 0) > 100.0
    assert (results.find("process of the shared map", "start") or 0) > 0.1
