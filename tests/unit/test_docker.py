"""The image's recipe fits the repository (no Docker engine is needed to see that)."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from splatbot.services.settings import ServiceSettings

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")


def _copied() -> list[str]:
    lines = re.findall(r"^COPY (?!--from)(.+)$", DOCKERFILE, flags=re.MULTILINE)
    return [source for line in lines for source in line.split()[:-1]]


def test_every_path_that_is_copied_exists_and_is_let_through_to_the_build() -> None:
    let_through = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert len(_copied()) >= 6
    for source in _copied():
        assert (ROOT / source).exists(), source
        assert f"!{source}" in let_through, source


def test_the_package_is_whole_in_the_image_although_its_folders_are_links() -> None:
    links = {link.name for link in (ROOT / "splatbot").iterdir() if link.is_symlink()}
    assert links == {"services", "robots", "sim", "configs"}
    assert links <= set(_copied())


def test_the_service_runs_as_a_user_without_rights_and_is_watched() -> None:
    runtime = DOCKERFILE.split("FROM ")[-1]
    assert re.search(r"^USER splatbot$", runtime, flags=re.MULTILINE)
    assert re.search(r"^HEALTHCHECK .*\n.*?/healthz", runtime, flags=re.MULTILINE)


def test_variables_of_the_image_are_settings_of_the_service() -> None:
    names = {name.lower() for name in re.findall(r"SPLATBOT_([A-Z_]+)=", DOCKERFILE)}
    assert names
    assert names <= set(ServiceSettings.model_fields)


def test_the_system_libraries_are_those_of_the_make_targets() -> None:
    script = (ROOT / ".ci" / "system-deps.sh").read_text(encoding="utf-8")
    listed = set(re.findall(r"\blib[a-z0-9.-]+\b", script.split("<<'TABLE'")[1].split("TABLE")[0])) | {
        "libgl1-mesa-dri"
    }
    packages = {name for name in listed if not name.endswith(".so") and ".so." not in name}
    runtime = DOCKERFILE.split("FROM ")[-1]
    assert len(packages) == 8
    assert packages <= set(runtime.split())


def test_compose_builds_that_recipe() -> None:
    compose = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))
    build = compose["services"]["splatbot"]["build"]
    context = (ROOT / "docker" / build["context"]).resolve()
    assert context == ROOT
    assert (context / build["dockerfile"]).is_file()


def test_the_container_has_no_rights_and_bounds() -> None:
    service = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))["services"]["splatbot"]
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["read_only"] is True
    assert all("size=" in mount for mount in service["tmpfs"])
    assert service["mem_limit"] == service["memswap_limit"]
    assert 0 < service["pids_limit"] <= 4096
    assert int(service["stop_grace_period"].removesuffix("s")) > ServiceSettings().shutdown_s
    assert "privileged" not in service
    assert "network_mode" not in service


def test_uploads_are_unpacked_on_a_volume_that_the_user_may_write() -> None:
    compose = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text(encoding="utf-8"))
    folder = re.findall(r"\bTMPDIR=(\S+)", DOCKERFILE)[0]
    assert f"uploads:{folder}" in compose["services"]["splatbot"]["volumes"]
    assert "uploads" in compose["volumes"]
    assert re.search(rf"install -d -o splatbot .*{folder}$", DOCKERFILE, flags=re.MULTILINE)
