"""`splatbot convert`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatbot.cli.paths import check_output
from splatbot.errors import InputError
from splatbot.formats import MapFormat, find_format, load_gaussians
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel

_HIGHEST_SH_DEGREE = 4


def convert(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|MAP")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    /,
    *,
    sh_degree: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    spz_version: Annotated[Literal[2, 3, 4] | None, tyro.conf.arg(metavar="2|3|4")] = None,
    ksplat_level: Annotated[Literal[0, 1, 2] | None, tyro.conf.arg(metavar="0|1|2")] = None,
) -> int:
    """Write a map in another format of Gaussian splats, as the suffix of OUT says.

    The suffixes are .ply (3DGS PLY), .compressed.ply, .splat, .ksplat, .spz, .sbz, .sog, _sog (a folder), .glb (glTF
    with KHR_gaussian_splatting), .usd, .usda, .usdc and .usdz (OpenUSD). The format of MAP is detected from its
    content.

    Prints the losses. Only .ply keeps all values. The bookkeeping of splatbot (observations, anchors, uncertainty and
    misses of each Gaussian) is kept by .ply and .sbz.

    Examples:
        splatbot convert runs/desk desk.spz
        splatbot convert runs/desk desk.sbz
        splatbot convert scene.sog scene.ply
        splatbot convert runs/desk desk.usdz
        splatbot convert map.ply map.compressed.ply --sh-degree 0
        splatbot convert map.ply map.spz --spz-version 4
        splatbot convert map.ply map.ksplat --ksplat-level 2

    Args:
        map: a map file, a run folder, or the folder of a SOG.
        out: file or folder to write.
        sh_degree: highest degree of spherical harmonics to keep; by default all that the format stores.
        spz_version: version of an .spz file; by default 3, which every reader of version 4 reads too.
        ksplat_level: compression level of a .ksplat file, by default 1. Level 0 keeps float32; 2 has 8 bits a harmonic.
    """
    file, target = map_file(map), find_format(out)
    check_output(out, "OUT", folder=target.suffix == "_sog")
    if sh_degree is not None and not 0 <= sh_degree <= _HIGHEST_SH_DEGREE:
        raise InputError(f"is {sh_degree}.", field="--sh-degree", hint=f"give 0 to {_HIGHEST_SH_DEGREE}")
    for option, value, module in (("--spz-version", spz_version, "spz"), ("--ksplat-level", ksplat_level, "ksplat")):
        if value is not None and target.module != module:
            raise InputError(f"is for .{module} files.", field=option, hint=f"leave it out, or name OUT .{module}")
    if out.resolve() in (file.resolve(), file.resolve().parent):
        raise InputError("is the input.", file=out, field="OUT", hint="name another file")

    from splatbot.results.units import count, megabytes

    model = load_gaussians(file)
    kept = _limited(model, _kept_degree(model, target, sh_degree, spz_version))
    _save(kept, out, target, spz_version, ksplat_level)
    notes = _losses(model, kept, target, _rounded(kept, target, ksplat_level))
    print(
        f"{out}: {count(len(kept))} Gaussians, SH degree {kept.sh_degree}, "
        f"{megabytes(_size(file))} to {megabytes(_size(out))}; {'; '.join(notes) or 'lost nothing'}"
    )
    return 0


def _kept_degree(model: GaussianModel, target: MapFormat, limit: int | None, spz_version: int | None) -> int:
    degrees = [model.sh_degree, target.max_sh_degree]
    degrees += [limit] if limit is not None else []
    degrees += [3] if spz_version == 2 else []
    return min(degrees)


def _limited(model: GaussianModel, degree: int) -> GaussianModel:
    from dataclasses import replace

    return replace(model, sh=model.sh[:, : (degree + 1) ** 2].contiguous())


def _save(
    model: GaussianModel,
    out: Path,
    target: MapFormat,
    spz_version: Literal[2, 3, 4] | None,
    ksplat_level: Literal[0, 1, 2] | None,
) -> None:
    if target.module == "ply":
        from splatbot.formats.ply import save_ply

        save_ply(model, out, bookkeeping=_has_bookkeeping(model))
    elif spz_version is not None:
        from splatbot.formats.spz import save_spz

        save_spz(model, out, spz_version)
    elif ksplat_level is not None:
        from splatbot.formats.ksplat import save_ksplat

        save_ksplat(model, out, ksplat_level)
    else:
        target.save(model, out)


def _has_bookkeeping(model: GaussianModel) -> bool:
    """Return whether a map has more than the bookkeeping of a map from another program."""
    plain = (model.observations == 1).all() and (model.anchors == -1).all()
    return not (plain and not model.uncertainty.any() and not model.misses.any())


def _rounded(kept: GaussianModel, target: MapFormat, ksplat_level: int | None) -> str:
    """Return the values that are not stored as float32, for users."""
    if ksplat_level == 0:
        return "colours, opacities"
    return f"{target.rounded}, harmonics" if target.rounded and kept.sh_degree else target.rounded


def _losses(model: GaussianModel, kept: GaussianModel, target: MapFormat, rounded: str) -> list[str]:
    lost = [f"SH degree {model.sh_degree} to {kept.sh_degree}"] if kept.sh_degree < model.sh_degree else []
    lost += ["bookkeeping"] if not target.has_bookkeeping and _has_bookkeeping(model) else []
    notes = [f"lost: {', '.join(lost)}"] if lost else []
    return notes + ([f"rounded: {rounded}"] if rounded else [])


def _size(path: Path) -> int:
    """Return the bytes of a map file, or of all files of a SOG's folder."""
    folder = path.parent if path.name == "meta.json" else path
    return sum(file.stat().st_size for file in folder.iterdir()) if folder.is_dir() else path.stat().st_size
