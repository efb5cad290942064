"""Recipes of docker/ fit the repository and the service, and keep its rights small. No engine or cluster is needed."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from splatbot.services.keys import check_hash
from splatbot.services.settings import ServiceSettings
from tests.container import (
    COMPOSE,
    DOCKERFILE,
    ROOT,
    container_of,
    copied,
    image,
    image_environment,
    instructions,
    seconds,
)

VARIABLES = {"SPLATBOT_API_KEYS": "sha256:" + "0" * 64}
SERVICES = ("splatbot", "viewer", "replay")
UNIT = ROOT / "docker" / "splatbot.service"
PODS = ROOT / "docker" / "kubernetes.yaml"


def tool(name: str) -> str:
    """Return the path of a program of the virtual environment."""
    return str(Path(sys.executable).with_name(name))


def ran(*words: str) -> str:
    """Run a program, which must end with code 0, and return its output."""
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def unit() -> dict[str, list[str]]:
    """Return the values of each directive of the systemd unit."""
    values = defaultdict(list)
    for line in UNIT.read_text(encoding="utf-8").splitlines():
        if re.match(r"\w+=", line):
            name, _, value = line.partition("=")
            values[name].append(value)
    return values


def objects() -> dict[str, dict[str, Any]]:
    """Return the objects of the cluster by their kinds."""
    return {one["kind"]: one for one in yaml.safe_load_all(PODS.read_text(encoding="utf-8"))}


def pod() -> dict[str, Any]:
    """Return the pod of the deployment."""
    spec: dict[str, Any] = objects()["Deployment"]["spec"]["template"]["spec"]
    return spec


class TestImage:
    def test_hadolint_finds_nothing_in_the_dockerfile(self) -> None:
        assert ran(tool("hadolint"), str(ROOT / "docker" / "Dockerfile")) == ""

    def test_every_path_that_is_copied_exists_and_is_let_through_to_the_build(self) -> None:
        let_through = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
        assert len(copied()) >= 6
        for source in copied():
            assert (ROOT / source).exists(), source
            assert f"!{source}" in let_through, source

    def test_the_package_is_whole_in_the_image_although_its_folders_are_links(self) -> None:
        links = {link.name for link in (ROOT / "splatbot").iterdir() if link.is_symlink()}
        assert links == {"services", "robots", "sim", "configs"}
        assert links <= set(copied())

    def test_the_service_runs_as_a_numbered_user_without_rights_and_is_watched(self) -> None:
        user, group = image()["user"].split(":")
        (setup,) = [rest for name, rest in instructions() if name == "RUN"]
        assert f"--uid {user} --gid {group}" in setup
        assert int(user) > 0
        assert "/healthz" in image()["healthcheck"]["test"][-1]

    def test_variables_of_the_image_are_settings_of_the_service(self) -> None:
        names = {name.removeprefix("SPLATBOT_").lower() for name in image_environment() if name.startswith("SPLATBOT_")}
        assert names
        assert names <= set(ServiceSettings.model_fields)

    def test_the_system_libraries_are_those_of_the_make_targets(self) -> None:
        script = (ROOT / ".ci" / "system-deps.sh").read_text(encoding="utf-8")
        listed = set(re.findall(r"\blib[a-z0-9.-]+\b", script.split("<<'TABLE'")[1].split("TABLE")[0])) | {
            "libgl1-mesa-dri"
        }
        packages = {name for name in listed if not name.endswith(".so") and ".so." not in name}
        assert len(packages) == 8
        assert packages <= set(DOCKERFILE.split("FROM ")[-1].split())


class TestCompose:
    def test_it_follows_the_schema_of_compose(self) -> None:
        ran(tool("check-jsonschema"), "--builtin-schema", "vendor.compose-spec", str(COMPOSE))

    def test_every_service_runs_the_image_of_the_dockerfile(self) -> None:
        for name in SERVICES:
            recipe = container_of(name, VARIABLES)
            context = (COMPOSE.parent / recipe["build"]["context"]).resolve()
            assert context == ROOT
            assert (context / recipe["build"]["dockerfile"]).is_file()

    def test_without_a_key_nothing_is_started(self) -> None:
        with pytest.raises(KeyError, match="SPLATBOT_API_KEYS"):
            container_of("splatbot", {})

    @pytest.mark.parametrize("name", SERVICES)
    def test_a_container_has_no_rights_and_bounds(self, name: str) -> None:
        recipe = container_of(name, VARIABLES)
        assert recipe["cap_drop"] == ["ALL"]
        assert recipe["security_opt"] == ["no-new-privileges:true"]
        assert recipe["read_only"] is True
        assert all("size=" in mount for mount in recipe["tmpfs"])
        assert recipe["mem_limit"] == recipe["memswap_limit"]
        assert 0 < recipe["pids_limit"] <= 4096
        assert seconds(recipe["stop_grace_period"]) > ServiceSettings().shutdown_s
        assert "privileged" not in recipe

    @pytest.mark.parametrize("name", SERVICES)
    def test_only_this_machine_reaches_a_container(self, name: str) -> None:
        recipe = container_of(name, VARIABLES)
        if recipe.get("network_mode") == "host":
            assert ServiceSettings(host=recipe["environment"]["SPLATBOT_HOST"]).loopback
        else:
            assert "network_mode" not in recipe
            assert all(port.startswith("127.0.0.1:") for port in recipe["ports"])

    def test_services_of_one_machine_take_different_ports(self) -> None:
        ports = [port.split(":")[1] for name in SERVICES for port in container_of(name, VARIABLES).get("ports", [])]
        replay = container_of("replay", VARIABLES)["environment"]
        ports += [replay["SPLATBOT_PORT"], replay["SPLATBOT_VIEWER_PORT"]]
        assert len(set(ports)) == 4

    def test_uploads_are_unpacked_on_a_volume_that_the_user_may_write(self) -> None:
        folder = image_environment()["TMPDIR"]
        assert f"uploads:{folder}" in container_of("splatbot", VARIABLES)["volumes"]
        assert "uploads" in yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["volumes"]
        (setup,) = [rest for name, rest in instructions() if name == "RUN"]
        assert re.search(rf"install -d -o splatbot -m 0700 {folder}$", setup.strip())


class TestUnit:
    @pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze belongs to systemd")
    def test_systemd_accepts_it_and_finds_little_exposure(self, tmp_path: Path) -> None:
        """The program of this environment replaces /opt/splatbot; 10 of 10 is a unit without any limit."""
        copy = tmp_path / UNIT.name
        copy.write_text(UNIT.read_text(encoding="utf-8").replace("/opt/splatbot", sys.prefix), encoding="utf-8")
        assert ran("systemd-analyze", "verify", "--man=no", str(copy)) == ""
        ran("systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", str(copy))

    def test_it_runs_without_rights_on_a_read_only_system(self) -> None:
        values = unit()
        for name in ("DynamicUser", "NoNewPrivileges", "PrivateTmp", "ProtectHome", "PrivateDevices"):
            assert values[name] == ["yes"], name
        assert values["ProtectSystem"] == ["strict"]
        assert values["CapabilityBoundingSet"] == values["AmbientCapabilities"] == [""]
        assert int(values["TimeoutStopSec"][0]) > ServiceSettings().shutdown_s
        assert values["KillSignal"] == ["SIGTERM"]

    def test_keys_come_from_a_file_without_which_it_does_not_start(self) -> None:
        assert [value for value in unit()["EnvironmentFile"] if not value.startswith("-")] == ["/etc/splatbot/keys.env"]
        assert "SPLATBOT_API_KEYS" not in "".join(unit()["Environment"])

    def test_its_variables_are_settings_and_lie_in_its_own_folder(self) -> None:
        variables = dict(word.split("=", 1) for word in shlex.split(unit()["Environment"][0]))
        names = {name.removeprefix("SPLATBOT_").lower() for name in variables if name.startswith("SPLATBOT_")}
        assert names <= set(ServiceSettings.model_fields)
        folder = f"%S/{unit()['StateDirectory'][0]}/"
        assert variables["SPLATBOT_DATA_DIR"].startswith(folder)
        assert unit()["ExecStartPre"] == [f"/bin/mkdir -p {variables['TMPDIR']}"]

    def test_its_limits_are_those_of_the_container(self) -> None:
        recipe, values = container_of("splatbot", VARIABLES), unit()
        assert values["MemoryMax"][0].lower() == recipe["mem_limit"]
        assert int(values["TasksMax"][0]) == recipe["pids_limit"]
        assert int(values["LimitNOFILE"][0]) == recipe["ulimits"]["nofile"]
        assert int(values["TimeoutStopSec"][0]) == seconds(recipe["stop_grace_period"])


class TestCluster:
    def test_the_schemas_of_kubernetes_accept_every_object(self) -> None:
        output = ran(tool("kubernetes-validate"), "--strict", str(PODS))
        assert output.count(" passed for resource ") == len(objects()) == 4

    def test_a_pod_has_no_rights_and_bounds(self) -> None:
        (container,) = pod()["containers"]
        user, group = map(int, image()["user"].split(":"))
        assert pod()["securityContext"] == {
            "runAsNonRoot": True,
            "runAsUser": user,
            "runAsGroup": group,
            "fsGroup": group,
            "seccompProfile": {"type": "RuntimeDefault"},
        }
        assert container["securityContext"] == {
            "readOnlyRootFilesystem": True,
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
        }
        assert container["resources"]["limits"]["memory"]
        assert pod()["automountServiceAccountToken"] is False
        assert pod()["terminationGracePeriodSeconds"] > ServiceSettings().shutdown_s

    def test_the_variables_of_service_links_are_off_because_the_service_reads_one(self) -> None:
        """Kubernetes sets NAME_PORT=tcp://ADDRESS:PORT for a Service NAME, and SPLATBOT_PORT is a setting."""
        linked = objects()["Service"]["metadata"]["name"].upper() + "_PORT"
        assert linked.removeprefix("SPLATBOT_").lower() in ServiceSettings.model_fields
        assert pod()["enableServiceLinks"] is False

    def test_probes_ask_routes_that_need_no_key_at_the_port_of_the_image(self) -> None:
        (container,) = pod()["containers"]
        paths = {kind: container[f"{kind}Probe"]["httpGet"]["path"] for kind in ("startup", "liveness", "readiness")}
        assert paths == {"startup": "/healthz", "liveness": "/healthz", "readiness": "/readyz"}
        assert container["ports"] == [{"name": "http", "containerPort": int(image_environment()["SPLATBOT_PORT"])}]
        assert objects()["Service"]["spec"]["ports"][0]["targetPort"] == "http"

    def test_every_written_folder_is_a_volume(self) -> None:
        (container,) = pod()["containers"]
        mounts = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
        assert set(mounts) == {"/tmp", image_environment()["TMPDIR"], container["args"][-1]}
        assert set(mounts.values()) == {volume["name"] for volume in pod()["volumes"]}
        assert objects()["PersistentVolumeClaim"]["metadata"]["name"] == "splatbot-maps"

    def test_one_pod_owns_the_maps(self) -> None:
        assert objects()["Deployment"]["spec"]["replicas"] == 1
        assert objects()["Deployment"]["spec"]["strategy"] == {"type": "Recreate"}

    def test_the_service_answers_to_its_names_in_the_cluster(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name, value in objects()["ConfigMap"]["data"].items():
            monkeypatch.setenv(name, value)
        name = objects()["Service"]["metadata"]["name"]
        assert {name, f"{name}.default.svc"} <= set(ServiceSettings().allowed_hosts)

    def test_keys_come_from_a_secret_that_the_file_does_not_hold(self) -> None:
        (container,) = pod()["containers"]
        assert {"secretRef": {"name": "splatbot-keys"}} in container["envFrom"]
        assert "Secret" not in objects()


@pytest.mark.parametrize("path", sorted((ROOT / "docker").iterdir()), ids=lambda path: path.name)
def test_no_key_is_in_the_recipes(path: Path) -> None:
    for text in re.findall(r"sha256:[^\s\"',]*", path.read_text(encoding="utf-8")):
        with pytest.raises(ValueError, match="no hash"):
            check_hash(text)
