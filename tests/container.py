"""The image of docker/Dockerfile, run in Linux namespaces as docker/compose.yaml describes it, without an engine.

The virtual environment of this checkout replaces the one that the image's builder makes. This machine's folders with
programs and libraries replace the base image. Limits of memory and processes, which need cgroups, do not apply.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from tests.waiting import until

ROOT = Path(__file__).parents[1]
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
COMPOSE = ROOT / "docker" / "compose.yaml"

BASE_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_SYSTEM = ("/bin", "/etc", "/lib", "/lib64", "/sbin", "/usr")
_DEVICES = ("null", "zero", "full", "random", "urandom")
_LOOPBACK_UP = (
    "import fcntl, socket, struct; SIOCSIFFLAGS, IFF_UP = 0x8914, 1\n"
    "fcntl.ioctl(socket.socket(), SIOCSIFFLAGS, struct.pack('16sh14x', b'lo', IFF_UP))"
)


@cache
def instructions(stage: int = -1) -> list[tuple[str, str]]:
    """Return the instructions of a stage of the Dockerfile, the last by default, as pairs of name and arguments."""
    text = re.sub(r"\\\n", " ", re.sub(r"^#.*\n", "", DOCKERFILE, flags=re.M))
    lines = re.split(r"^FROM .*$", text, flags=re.M)[1:][stage].split("\n")
    return [(name, rest) for name, _, rest in (line.partition(" ") for line in lines) if name]


def instruction(name: str) -> str:
    """Return the arguments of the only instruction of a name in the last stage."""
    (found,) = [rest for other, rest in instructions() if other == name]
    return found


def image_environment() -> dict[str, str]:
    """Return the variables of the image; PATH begins with the one of its base."""
    words = shlex.split(instruction("ENV").replace("$PATH", BASE_PATH))
    return dict(word.split("=", 1) for word in words)


def health_check() -> list[str]:
    """Return the words of the image's health check."""
    words: list[str] = json.loads(instruction("HEALTHCHECK").split("CMD ", 1)[1])
    return words


def image() -> dict[str, Any]:
    """Return the image's part of a container, in the names of compose."""
    return {
        "user": instruction("USER"),
        "environment": image_environment(),
        "entrypoint": json.loads(instruction("ENTRYPOINT")),
        "command": json.loads(instruction("CMD")),
        "healthcheck": {"test": ["CMD", *health_check()]},
        "stop_signal": instruction("STOPSIGNAL"),
        "volumes": [f"{instruction('VOLUME')}:{instruction('VOLUME')}"],
    }


def copied(stage: int = 0) -> list[str]:
    """Return the paths of the repository that a stage copies, the builder by default."""
    return [path for name, rest in instructions(stage) if name == "COPY" for path in rest.split()[:-1]]


def copy_build_context(folder: Path) -> None:
    """Copy into a folder the files that the builder copies, without those that .dockerignore excludes."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    excluded = shutil.ignore_patterns(*(line.removeprefix("**/") for line in lines if line.startswith("**/")))
    for name in copied():
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=excluded)
        else:
            shutil.copy(ROOT / name, folder / name)


def container_of(name: str, variables: Mapping[str, str]) -> dict[str, Any]:
    """Return a service of the compose file with the image's values where it states none.

    Args:
        name: of the service.
        variables: replace ``${NAME:-default}`` and ``${NAME:?message}``.
    """

    def value(match: re.Match[str]) -> str:
        found = variables.get(match[1]) or (match[3] if match[2] == "-" else None)
        if found is None:
            raise KeyError(f"{match[1]}: {match[3]}")
        return found

    text = re.sub(r"\$\{(\w+):([-?])([^}]*)\}", value, COMPOSE.read_text(encoding="utf-8"))
    base, service = image(), yaml.safe_load(text)["services"][name]
    if "entrypoint" in service:
        del base["command"]
    mounted = {volume.split(":")[1] for volume in service["volumes"]}
    volumes = service["volumes"] + [volume for volume in base["volumes"] if volume.split(":")[1] not in mounted]
    environment = base["environment"] | {key: str(text) for key, text in service["environment"].items()}
    return base | service | {"volumes": volumes, "environment": environment}


def seconds(duration: str) -> float:
    """Return a duration of the compose file, such as 30s, in seconds."""
    return float(duration.removesuffix("s"))


@dataclass(frozen=True)
class Container:
    """A running container.

    Args:
        recipe: the service of the compose file with the image's values.
        process: `unshare`, whose exit code is the one of the container.
        pid: number of its first process on this machine.
    """

    recipe: dict[str, Any]
    process: subprocess.Popen[str]
    pid: int

    def run(self, words: Sequence[str], *, as_root: bool = False) -> subprocess.CompletedProcess[str]:
        """Run a command in the container with its user and variables, as `docker exec` does."""
        enter = ("nsenter", f"--target={self.pid}", "--mount", "--net", "--pid", "--root", "--wd=/")
        user = () if as_root else _as_user(self.recipe)
        return subprocess.run(
            [*enter, *user, *_variables(self.recipe), *words], capture_output=True, text=True, timeout=60
        )

    def is_healthy(self) -> bool:
        """Return whether its health check passes; a container that has ended fails the test."""
        assert self.process.poll() is None, "the container has ended"
        return self.run(self.recipe["healthcheck"]["test"][1:]).returncode == 0

    def status(self) -> dict[str, str]:
        """Return the fields of /proc/PID/status of its first process."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}

    def stop(self, within_s: float | None = None) -> int:
        """End it as `docker stop` does, and return its exit code.

        Args:
            within_s: [s] after which an engine would kill it, that of the recipe by default.

        Raises:
            subprocess.TimeoutExpired: an engine would kill it.
        """
        os.kill(self.pid, signal.Signals[self.recipe["stop_signal"]])
        return self.process.wait(seconds(self.recipe["stop_grace_period"]) if within_s is None else within_s)


@contextmanager
def started(recipe: dict[str, Any], folder: Path) -> Iterator[Container]:
    """Start a container, and kill it at the end of the block.

    Args:
        recipe: of :func:`container_of`.
        folder: empty; its root file system and its volumes are mounted there.
    """
    words = [*_as_user(recipe), *_variables(recipe), *recipe["entrypoint"], *recipe["command"]]
    limits = [f"--{name}={limit}" for name, limit in recipe["ulimits"].items()]
    root = folder / "root"
    script = "\n".join(
        [
            "set -e",
            *_mounts(recipe, root, folder),
            shlex.join(["exec", "prlimit", *limits, "chroot", str(root), *words]),
        ]
    )
    isolate = ("unshare", "--mount", "--pid", "--net", "--ipc", "--uts", "--fork", "--kill-child=KILL")
    process = subprocess.Popen([*isolate, "sh", "-c", script], text=True)
    first: list[int] = []

    def has_its_root() -> bool:
        assert process.poll() is None, "the container has ended"
        first[:] = map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())
        return bool(first) and Path(f"/proc/{first[0]}/root").readlink() == root

    try:
        until(has_its_root)
        yield Container(recipe, process, first[0])
    finally:
        if process.poll() is None:  # the change of the user has undone --kill-child
            for pid in first:
                os.kill(pid, signal.SIGKILL)
            process.kill()
        process.wait(10)


def _as_user(recipe: dict[str, Any]) -> list[str]:
    user, group = recipe["user"].split(":")
    assert recipe["cap_drop"] == ["ALL"]
    assert recipe["security_opt"] == ["no-new-privileges:true"]
    rights = ("--clear-groups", "--no-new-privs", "--bounding-set=-all", "--inh-caps=-all")
    return ["setpriv", f"--reuid={user}", f"--regid={group}", *rights]


def _variables(recipe: dict[str, Any]) -> list[str]:
    return ["env", "-i", "HOME=/nonexistent", *(f"{name}={value}" for name, value in recipe["environment"].items())]


def _mounts(recipe: dict[str, Any], root: Path, folder: Path) -> Iterator[str]:
    """Yield the shell's lines that build the container's file system below ``root``."""
    yield f"mkdir {root} && mount -t tmpfs -o mode=755 tmpfs {root}"
    python, checkout = Path(sys.base_prefix), Path(sys.prefix)
    for path in map(Path, _SYSTEM):
        if path.is_symlink():
            yield f"ln -s {path.readlink()} {root}{path}"
        elif path.exists():
            yield _bind(path, f"{root}{path}")
    for mount in recipe["tmpfs"]:
        target, options = mount.split(":")
        yield f"mkdir -p {root}{target} && mount -t tmpfs -o {options} tmpfs {root}{target}"
    if not python.is_relative_to("/usr"):  # these may lie in a folder of a tmpfs
        yield _bind(python, f"{root}{python}")
    yield _bind(ROOT, f"{root}{ROOT}")
    yield _bind(checkout, f"{root}/opt/splatbot")
    yield _bind(Path("/sys"), f"{root}/sys")
    yield f"mkdir {root}/proc && mount -t proc proc {root}/proc"
    yield f"mkdir {root}/dev && mount -t tmpfs -o mode=755 tmpfs {root}/dev"
    for device in _DEVICES:
        yield f"touch {root}/dev/{device} && mount --bind /dev/{device} {root}/dev/{device}"
    yield f"mkdir {root}/dev/shm && mount -t tmpfs -o size=64m,mode=1777 tmpfs {root}/dev/shm"
    for volume in recipe["volumes"]:
        source, target, *options = volume.split(":")
        if source.startswith((".", "/")) and source != target:
            yield _bind((COMPOSE.parent / source).resolve(), f"{root}{target}", *options)
        else:  # a volume of the engine, which copies the owner of the image's folder
            store = folder / f"volume{target.replace('/', '-')}"
            yield f"install -d -o {recipe['user'].split(':')[0]} -m 0700 {store}"
            yield _bind(store, f"{root}{target}", "rw")
    yield shlex.join([sys.executable, "-c", _LOOPBACK_UP])
    if recipe["read_only"]:
        yield f"mount -o remount,ro {root}"


def _bind(source: Path, target: str, access: str = "ro") -> str:
    return f"mkdir -p {target} && mount --bind -o {access} {shlex.quote(str(source))} {target}"
