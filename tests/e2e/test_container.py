"""Containers of docker/compose.yaml, and the pod of docker/kubernetes.yaml, started in namespaces.

They have the user, variables, mounts and rights of the image and the recipe. No engine is needed.
`tests/container.py` states the differences from an image that an engine builds.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.container import ROOT, container_of, started
from tests.contracts.conftest import wall
from tests.e2e.conftest import splatbot_here
from tests.waiting import until

NAMESPACES = ["unshare", "--mount", "--pid", "--net", "--fork", "true"]
GET = """import sys, urllib.request as u
url, key, *host = sys.argv[1:]
headers = {'X-API-Key': key} | {'Host': name for name in host}
print(u.urlopen(u.Request(url, headers=headers)).read().decode())"""

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        os.geteuid() != 0 or subprocess.run(NAMESPACES, capture_output=True).returncode != 0,
        reason="namespaces with mounts need root, and CAP_SYS_ADMIN in a container",
    ),
]


@pytest.fixture(scope="module")
def key_and_hash() -> tuple[str, str]:
    """A new key, and the hash of it that the service gets."""
    text = splatbot_here("serve", "--new-key").out
    (hashed,) = re.findall(r"sha256:\w+", text)
    (key,) = set(re.findall(r"\b[\w-]{40,}\b", text)) - {hashed.removeprefix("sha256:")}
    return key, hashed


@pytest.fixture
def variables(key_and_hash: tuple[str, str], tmp_path: Path) -> dict[str, str]:
    """Variables of the compose file: a key's hash, and a folder with a map that every user may read."""
    folder = tmp_path / "map"
    folder.mkdir()
    wall().model.save(folder / "map.ply")
    folder.chmod(0o755)
    (folder / "map.ply").chmod(0o644)
    return {"SPLATBOT_API_KEYS": key_and_hash[1], "MAP_DIR": str(folder)}


def test_the_service_serves_the_mounted_map_without_rights_and_ends_within_5_s(
    variables: dict[str, str], key_and_hash: tuple[str, str], tmp_path: Path
) -> None:
    recipe = container_of("splatbot", variables)
    with started(recipe, tmp_path) as container:
        until(container.is_healthy, timeout_s=120)

        def get(path: str) -> Any:
            answer = container.run(["python", "-c", GET, f"http://127.0.0.1:8000{path}", key_and_hash[0]])
            assert answer.returncode == 0, answer.stderr
            return json.loads(answer.stdout)

        assert get("/readyz")["status"] == "ready"
        assert [m["id"] for m in get("/v1/maps")["maps"]] == ["default"]

        status = container.status()
        assert status["Uid"].split() == ["10001"] * 4
        assert status["Gid"].split() == ["10001"] * 4
        assert status["Groups"] == ""
        assert status["NoNewPrivs"] == "1"
        assert {int(status[f"Cap{kind}"], 16) for kind in ("Inh", "Prm", "Eff", "Bnd", "Amb")} == {0}
        assert status["NSpid"].split()[-1] == "1"

        for place in ("/", "/opt/splatbot", "/map", "/etc"):
            refused = container.run(["touch", f"{place}/probe"], as_root=True)
            assert "Read-only file system" in refused.stderr, place
        for place in ("/tmp", "/uploads"):
            assert container.run(["touch", f"{place}/probe"]).returncode == 0, place
        assert container.stop(within_s=5.0) == 0


def test_the_viewer_asks_for_the_key_and_ends_at_its_stop_signal(variables: dict[str, str], tmp_path: Path) -> None:
    with started(container_of("viewer", variables), tmp_path) as container:
        until(container.is_healthy, timeout_s=120)
        page = container.run(["python", "-c", GET, "http://127.0.0.1:8001/", "no key"])
        assert "HTTP Error 401" in page.stderr
        assert container.stop() == 130


def test_the_replay_maps_a_simulated_scene_and_opens_its_viewer(
    variables: dict[str, str], key_and_hash: tuple[str, str], tmp_path: Path
) -> None:
    recipe = container_of("replay", variables | {"LOG_DIR": str(tmp_path)})
    with started(recipe, tmp_path) as container:
        until(container.is_healthy, timeout_s=120)
        service, key = "http://127.0.0.1:8010/v1/maps/default", key_and_hash[0]

        def gaussians() -> int:
            answer = container.run(["python", "-c", GET, service, key])
            assert answer.returncode == 0, answer.stderr
            return int(json.loads(answer.stdout).get("gaussians") or 0)

        until(gaussians, timeout_s=120)
        viewer = container.run(["python", "-c", GET, "http://127.0.0.1:8011/", key])
        assert "HTTP Error 401" in viewer.stderr
        assert container.stop() == 0


def test_the_pod_of_the_cluster_is_ready_without_maps_and_answers_to_the_name_of_its_service(
    variables: dict[str, str], key_and_hash: tuple[str, str], tmp_path: Path
) -> None:
    """Folders of this machine replace the volumes; the kubelet's probes are requests from inside."""
    objects = {one["kind"]: one for one in yaml.safe_load_all((ROOT / "docker" / "kubernetes.yaml").read_text())}
    (pod,) = objects["Deployment"]["spec"]["template"]["spec"]["containers"]
    recipe = container_of("splatbot", variables)
    recipe["command"] = pod["args"]
    recipe["environment"] |= objects["ConfigMap"]["data"]
    mounts = {mount["mountPath"] for mount in pod["volumeMounts"]} - {"/tmp"}
    recipe["volumes"] = [f"{mount.strip('/')}:{mount}" for mount in mounts]
    with started(recipe, tmp_path) as container:
        until(container.is_healthy, timeout_s=120)
        for kind in ("startupProbe", "livenessProbe", "readinessProbe"):
            probe = container.run(["python", "-c", GET, f"http://127.0.0.1:8000{pod[kind]['httpGet']['path']}", ""])
            assert probe.returncode == 0, probe.stderr
        (service, foreign) = (
            container.run(["python", "-c", GET, "http://127.0.0.1:8000/v1/maps", key_and_hash[0], host])
            for host in ("splatbot.default.svc:8000", "other.default.svc:8000")
        )
        assert json.loads(service.stdout) == {"maps": []}
        assert "HTTP Error 421" in foreign.stderr
        assert container.stop(within_s=5.0) == 0
