"""Checks of paths before a command loads its libraries, and errors of disks in plain words."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

from splatbot.errors import FormatError, InputError
from splatbot.layouts import RECORDING, TRAINING_NAME, check_run_folder

_FIXES = {
    errno.ENOSPC: "free some space, or write to another disk",
    errno.EDQUOT: "free some of your quota, or write to another disk",
    errno.EFBIG: "raise the limit of file sizes (ulimit -f), or write to another disk",
    errno.EROFS: "mount the disk for writing, or write to another one",
    errno.EACCES: "change the permissions, or name another place",
    errno.EPERM: "change the permissions, or name another place",
    errno.EIO: "check the disk, or name another one",
    errno.ESTALE: "mount the network folder again",
    errno.ENOTCONN: "mount the folder again",
    errno.ENODEV: "connect the device or mount the folder again",
    errno.ENXIO: "connect the device or mount the folder again",
    errno.ENOENT: "check whether the folder was removed or unmounted",
    errno.ENOTDIR: "name a folder, not a file in it",
    errno.EISDIR: "name a file, not a folder",
    errno.ENAMETOOLONG: "use a shorter name",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
}


def system_error(error: OSError) -> str | None:
    """Return an error of the disk or the file system as one sentence with a fix, or None for other errors."""
    fix = _FIXES.get(error.errno or 0)
    if fix is None or isinstance(error, ConnectionError):
        return None
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{(error.strerror or 'failed').lower()}. Fix: {fix}"


def check_output(path: Path | None, flag: str = "--out", *, folder: bool = True) -> None:
    """Check that a file or a folder can be written at a path, without creating it.

    A nameless file in the nearest folder that exists shows it. Permissions alone do not: root may write to each folder,
    but /proc takes no files.

    Raises:
        InputError: the path names something else, or the folder takes no files.
        OSError: the folder or its disk is not for writing.
    """
    if path is None:
        return
    if path.exists() and path.is_dir() != folder:
        raise InputError(
            f"is a {'file' if folder else 'folder'}.",
            file=path,
            field=flag,
            hint=f"name a {'folder' if folder else 'file'}",
        )
    place = path.absolute()
    while not place.exists():
        place = place.parent
    if not place.is_dir() and (folder or place != path.absolute()):
        raise InputError(f"is below {place}, which is a file.", file=path, field=flag, hint="name another place")
    if not os.access(place, os.W_OK):
        code = errno.EROFS if os.statvfs(place).f_flag & os.ST_RDONLY else errno.EACCES
        raise OSError(code, os.strerror(code), str(path))
    if place.is_dir():
        try:
            with tempfile.TemporaryFile(dir=place):
                pass
        except FileNotFoundError as error:  # of /proc, which exists and takes no files
            hint = f"name a place outside {place}, which takes no files"
            raise InputError("cannot be created.", file=path, field=flag, hint=hint) from error
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error


def result_folder(out: Path | None, name: str, *holds: str, overwrite: bool) -> tuple[Path, bool]:
    """Return the folder of the results of a query, and whether results of an earlier call are replaced there.

    Each call replaces those in the default folder runs/NAME. A folder that the user names keeps them.

    Args:
        out: the named folder. If None, the default is used.
        name: of the default folder in runs/.
        holds: files that a call writes.
        overwrite: replace results in a named folder too.

    Raises:
        InputError: the named folder holds results and ``overwrite`` is not set, or it is no folder for files.
        OSError: the folder or its disk is not for writing.
    """
    folder = Path("runs") / name if out is None else out
    check_output(folder)
    found = [file for file in holds if (folder / file).exists()]
    if found and out is not None and not overwrite:
        hint = "name another folder, or give --overwrite to replace it"
        raise InputError(f"holds earlier results ({', '.join(found)}).", file=folder, field="--out", hint=hint)
    return folder, bool(found)


def written_to(folder: Path, replaced: bool) -> str:
    """Return words for the folder of results, see :func:`result_folder`."""
    return f"{folder}, in place of earlier results" if replaced else str(folder)


def check_new(path: Path, *, overwrite: bool) -> None:
    """Check that a path is free, or that its content may be replaced.

    Raises:
        InputError: it exists, and ``overwrite`` is not set.
    """
    if path.exists() and not overwrite:
        raise InputError("exists already.", file=path, field="--out", hint="name another one, or give --overwrite")


def check_run(run: Path, field: str = "run") -> None:
    """Check that a path is a folder of a run.

    Raises:
        FormatError: it is not.
    """
    check_run_folder(run, field)
    if not (run / "metrics.json").is_file():
        hint = "give a folder that `splatbot map` wrote"
        raise FormatError("is no folder of a run: it has no metrics.json.", file=run, field=field, hint=hint)


def check_state(run: Path, field: str = "run") -> None:
    """Check that a run has a saved state, to continue it or to localise in it.

    Raises:
        FormatError: it has none.
    """
    check_run_folder(run, field)
    state = run / "state" / "run.state"
    if state.is_file():
        return
    if any(run.iterdir()) and not (run / RECORDING).is_file():
        check_run(run, field)
    why = "the run ended before its first save (--save-every, 30 s), or was mapped with --save-every 0"
    hint = f"map the log again: splatbot map LOG --out {run} --overwrite --save-every 10"
    raise FormatError(f"there is no saved state: {why}.", file=state, hint=hint)


def check_training(folder: Path, field: str) -> None:
    """Check that a path is a folder of a training.

    Raises:
        FormatError: it is not.
    """
    if not (folder / TRAINING_NAME).is_file():
        problem = "holds no training" if folder.is_dir() else "is no folder" if folder.exists() else "does not exist"
        hint = "give a folder that `splatbot train` wrote"
        raise FormatError(f"{problem}.", file=folder, field=field, hint=hint)


def check_source(source: str, field: str) -> None:
    """Check that a folder of images, a log or a file exists.

    Raises:
        InputError: it does not.
    """
    if not source.startswith("synthetic:") and not any(Path(it).exists() for it in (source, source.partition("?")[0])):
        raise InputError("does not exist.", file=source, field=field, hint="check the path")


def check_camera(camera: str | None) -> None:
    """Check that a camera that is named like a file exists; presets are names.

    Raises:
        InputError: it does not.
    """
    if camera is not None and ("/" in camera or camera.endswith(".json")):
        check_file(Path(camera), "--camera")


def check_file(path: Path | None, flag: str) -> None:
    """Check that a file exists.

    Raises:
        InputError: it does not.
    """
    if path is not None and not path.is_file():
        problem = "is a folder." if path.is_dir() else "does not exist."
        raise InputError(problem, file=path, field=flag, hint="check the path")
