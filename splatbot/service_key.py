"""File with the key of this user's service on loopback, which clients of the same user read."""

from __future__ import annotations

import os
import secrets
import stat
from pathlib import Path

from splatbot.errors import ConfigError


def key_file() -> Path:
    """Return $XDG_STATE_HOME/splatbot/service-key, by default in ~/.local/state."""
    state = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not state.is_absolute():
        try:
            home = Path.home()
        except RuntimeError:  # the user has no home
            home = Path("/nonexistent")
        state = home / ".local" / "state"
    return state / "splatbot" / "service-key"


def read_key(path: Path) -> str | None:
    """Read the key of a file; None if there is no file.

    Raises:
        ConfigError: another user can read or owns the file, or it is empty.
    """
    try:
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            key = file.read(1024).decode("ascii", "replace").strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror}).", file=path, hint="check its permissions") from error
    if about.st_uid != os.geteuid() or stat.S_IMODE(about.st_mode) & 0o077:
        hint = f"make a new key: rm {path}"
        raise ConfigError("holds a key and is open to other users.", file=path, hint=hint)
    if not key:
        raise ConfigError("holds no key.", file=path, hint=f"make a new key: rm {path}")
    return key


def make_key(path: Path, key: str) -> str:
    """Write ``key`` to a file that only this user can read, unless the file exists; return the key of the file.

    Raises:
        ConfigError: the file cannot be written, or another user can read it.
    """
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:  # noqa: PTH123
                file.write(key + "\n")
                file.flush()
                os.fsync(file.fileno())
            os.link(draft, path)  # unlike a rename, this keeps the key of a service that starts at the same time
        finally:
            draft.unlink(missing_ok=True)
    except FileExistsError:
        pass  # the key of the file counts: it is returned below
    except OSError as error:
        hint = "set XDG_STATE_HOME to a folder that can be written, or SPLATBOT_API_KEYS"
        raise ConfigError(f"the key cannot be written ({error.strerror}).", file=path, hint=hint) from error
    kept = read_key(path)
    if kept is None:
        raise ConfigError("has disappeared.", file=path, hint="start the service again")
    return kept
