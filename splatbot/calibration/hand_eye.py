"""Hand-eye calibration: camera, target and joint offsets of an arm by least squares.

A camera on a link sees a static target, or a static camera sees a target on a link. The moving frame is the one on the
link, the static frame the one in the base. X is the pose of the moving frame on the link, and Y that of the static
frame in the base. With the pose F_k of the link and the measured pose C_k of the moving frame in the static one,

    F(q_k + δ) X = Y C_k.

Lengths of the board or the map may be wrong by one scale s: C_k then holds true lengths divided by s. Motions of the
link that shift the camera determine s, because the arm measures in metres.

The closed form of Park and Martin (1994) gives the start. Least squares over all views follow, on reprojection errors
of a board or on errors of tracked poses, with Huber's loss. Weak priors hold joint offsets that the motion does not
determine; their standard deviation shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatbot.calibration.estimate import Estimate
from splatbot.calibration.link_motion import LinkMotion
from splatbot.calibration.measurements import Measurement
from splatbot.errors import InputError
from splatbot.geometry import inverse, nearest_rotation, se3_exp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HandEyeConstants:
    """Constants of the hand-eye calibration."""

    pose_prior: float = 10.0
    """Standard deviation [m and rad] of the prior of X and Y around the closed form: none for any arm in a room."""
    offset_prior: float = 0.02
    """Standard deviation [rad or m] of the prior of a joint offset. Recorded arms err by up to 17 mrad."""
    delay_prior: float = 1.0
    """Standard deviation [s] of the prior of the time offset, around the one of the cross-correlation."""
    scale_prior: float = 1.0
    """Standard deviation [1] of the prior of the logarithm of the scale of board or map."""
    gain: float = 0.9
    """Largest held-out error with joint offsets or a scale, as a share [1] of that without, that takes them."""
    largest_offset_sigma: float = 0.005
    """Largest standard deviation [rad or m] of a useful joint offset: that of a person's own adjustment."""
    largest_scale_sigma: float = 0.005
    """Largest standard deviation [1] of a useful scale: a ruler measures a board of 0.2 m to 1 mm."""
    largest_delay_sigma: float = 0.005
    """Largest standard deviation [s] of a useful time offset."""
    largest_pose_sigma: tuple[float, float] = (0.02, 0.035)
    """Largest standard deviations of useful poses: of a coordinate [m], and of a rotation [rad], 2 degrees."""
    huber: float = 1.0
    """Error [1], in standard deviations, from which Huber's loss is linear. Errors of an arm are not Gaussian."""
    steps: int = 60
    """Largest number of steps of one solution [1]. Views that determine the unknowns take 10 to 30."""
    rounds: int = 4
    """Number of solutions [1] with standard deviations from the errors of the one before; they change by less than 1 %
    after three."""
    least_share: float = 0.05
    """Least share [1] of small errors, in the units of the weights, that the jackknife divides by."""
    blocks: int = 40
    """Largest number of blocks of neighbouring views [1] that are held out together or left out by the jackknife."""
    least_turn: float = 0.02
    """Least second-largest spread of the rotations of the link [rad]; below, all of them are about one axis."""
    held_out_every: int = 3
    """Every how many blocks one is held out [1] to compare the models."""


CONSTANTS = HandEyeConstants()
UNKNOWABLE = ("it turns the base, whose pose is unknown too", "it turns the hand, on which the pose is unknown too")
"""Why no views determine the offsets of the first joint and of the last one before the link."""
MIN_VIEWS = 6
"""Least number of views [1]: three motions determine X, and held-out views need as many again."""
_LOSS: dict[str, Any] = {"loss": "huber", "f_scale": CONSTANTS.huber, "x_scale": "jac", "max_nfev": CONSTANTS.steps}


class HandEyeUnknowns(NamedTuple):
    """Unknowns in addition to the two poses: whether joint offsets and a scale are among them."""

    offsets: bool
    scale: bool

    def __str__(self) -> str:
        names = [name for name, taken in (("joint offsets", self.offsets), ("scale", self.scale)) if taken]
        return f"with {' and '.join(names)}" if names else "without joint offsets"


@dataclass(frozen=True, eq=False)
class HandEyeCalibration:
    """Estimated poses, offsets and their standard deviations.

    Args:
        T_link_moving: (4, 4) pose X on the link: of the camera, or of a board in front of a static camera [m].
        T_base_static: (4, 4) pose Y in the base: of the board or the map, or of a static camera [m].
        covariance_moving, covariance_static: (6, 6) of the twists (translation [m], rotation [rad]) of both, along the
            axes of the moving and of the static frame.
        offsets: offset of each joint [rad or m], to be added to its measured position; empty if none is estimated.
        scale: true lengths of the board or map, divided by those that are given [1]; None if it is taken to be 1.
        delay: time offset [s]: the link was at the pose of a view this time after the view's stamp.
        error: median error over all views in ``unit``.
        largest_error: largest error of a useful calibration.
        held_out: median error of held-out views for each model that was compared.
        unit: unit of the errors.
        views: number of views.
    """

    T_link_moving: Array
    T_base_static: Array
    covariance_moving: Array
    covariance_static: Array
    offsets: dict[str, Estimate]
    scale: Estimate | None
    delay: Estimate | None
    error: float
    largest_error: float
    held_out: dict[HandEyeUnknowns, float]
    unit: str
    views: int

    @property
    def sigma_moving(self) -> Array:
        """Standard deviations (6,) of X: translation [m] and rotation [rad] along the axes of the moving frame."""
        return np.asarray(np.sqrt(np.diag(self.covariance_moving)))

    @property
    def sigma_static(self) -> Array:
        """Standard deviations (6,) of Y: translation [m] and rotation [rad] along the axes of the static frame."""
        return np.asarray(np.sqrt(np.diag(self.covariance_static)))

    def check(self, *, moving: bool, static: bool) -> None:
        """Check that the poses that are used are determined, and that the views agree with them.

        Args:
            moving, static: whether X and Y are used.

        Raises:
            InputError: the error of the views or a standard deviation is too large.
        """
        if self.error > self.largest_error:
            raise InputError(
                f"disagree by {self.error:.1f} {self.unit}, more than {self.largest_error:.1f}.",
                field="views and arm",
                hint="check the side of a square, the robot, radians, inverted poses, and --eye-to-hand",
            )
        for used, name, sigma in ((moving, "link", self.sigma_moving), (static, "base", self.sigma_static)):
            shift, turn = float(sigma[:3].max()), float(sigma[3:].max())
            if used and (shift > CONSTANTS.largest_pose_sigma[0] or turn > CONSTANTS.largest_pose_sigma[1]):
                raise InputError(
                    f"is not determined, its deviation is {1e3 * shift:.0f} mm, {np.degrees(turn):.1f} degrees.",
                    field=f"pose in the {name}",
                    hint="turn the link about two axes or more, by 20 degrees or more, in 15 views or more",
                )

    @property
    def joint_offsets(self) -> Array:
        """Offsets (J,) of all joints [rad or m], 0 where the views do not determine one."""
        return np.array([0.0 if e.refusal else e.value for e in self.offsets.values()])


def calibrate_hand_eye(
    motion: LinkMotion,
    measured: Measurement,
    *,
    offsets: bool | None = None,
    scale: bool | None = False,
    delay: float | None = None,
) -> HandEyeCalibration:
    """Estimate the poses X and Y, and optionally joint offsets, the scale of the board or map, and a time offset.

    Every third view is held out to compare the models. All views give the result.

    Args:
        motion: poses of the link, one for each view.
        measured: measured poses, one for each view.
        offsets: whether joint offsets are estimated. If None, they are if this lowers the held-out error by a tenth.
        scale: whether the scale is estimated; None as for ``offsets``. A scale that the views do not determine is 1.
        delay: time offset [s] that the stamps of the motion already lack; a correction is estimated. If None, both have
            one clock.

    Raises:
        InputError: there are fewer than 6 views, the link turns about one axis only, or ``scale`` is True and not
            determined.
    """
    if len(motion) < MIN_VIEWS:
        raise InputError(f"has {len(motion)} usable views.", field="views", hint=f"give {MIN_VIEWS} or more")
    # The first joint turns the base, the last one the hand: see UNKNOWABLE.
    joints = motion.offsets[1:-1] if offsets is not False else ()
    compared = [HandEyeUnknowns(o, s) for o in (False, True)[: 1 + bool(joints)] for s in _allowed(scale)]
    held_out = {m: _held_out_error(motion, measured, joints if m.offsets else (), m.scale, delay) for m in compared}
    chosen, *others = [m for m in compared if m.offsets in _allowed(offsets if joints else False)]
    for other in others:
        if held_out[other] <= CONSTANTS.gain * held_out[chosen]:
            chosen = other
    free, scaled = joints if chosen.offsets else (), chosen.scale
    refused, refused_scale = dict[str, Estimate](), None
    while True:
        model = _Model(motion, measured, free, scaled, delay)
        found = model.result(model.solve(), held_out, refused, refused_scale)
        # Unknowns may trade off: without the least certain one, the others may be determined.
        weak = {name: e.sigma / CONSTANTS.largest_offset_sigma for name, e in found.offsets.items() if e.refusal}
        least = max((name for name in free if name in weak), key=weak.__getitem__, default="")
        if scaled and found.scale is not None and found.scale.refusal:
            if scale:
                hint = "shift the camera more between the views, or measure the lengths and leave the scale out"
                raise InputError(f"is not determined: {found.scale.refusal}.", field="scale", hint=hint)
            if found.scale.sigma / CONSTANTS.largest_scale_sigma > weak.get(least, 0.0):
                refused_scale, scaled = found.scale, False
                continue
        if not least:
            return found
        refused[least] = found.offsets[least]
        free = tuple(name for name in free if name != least)


def _allowed(wanted: bool | None) -> tuple[bool, ...]:
    """Return whether an unknown may be left out or taken."""
    return (False, True) if wanted is None else (wanted,)


def _held_out_error(
    motion: LinkMotion, measured: Measurement, free: tuple[str, ...], scaled: bool, delay: float | None
) -> float:
    """Return the median error of every third block of views of a fit to the others."""
    rows = np.arange(len(motion))
    blocks = np.array_split(rows, min(len(rows), CONSTANTS.blocks))
    out = np.isin(rows, np.concatenate(blocks[:: CONSTANTS.held_out_every]))
    fitted = _Model(motion.select(rows[~out]), measured.select(rows[~out]), free, scaled, delay)
    solution = fitted.solve()
    start = fitted.X, fitted.Y
    test = _Model(motion.select(rows[out]), measured.select(rows[out]), free, scaled, delay, start=start)
    return test.measured.error(test.measured.residuals(test.predict(solution)))


class _Model:
    """Least squares of one set of views.

    The unknowns x are the twists of X and Y around their start, the joint offsets, the logarithm of the scale, and the
    time offset.
    """

    def __init__(
        self,
        motion: LinkMotion,
        measured: Measurement,
        names: tuple[str, ...],
        scaled: bool,
        delay: float | None,
        start: tuple[Array, Array] | None = None,
    ) -> None:
        self.motion, self.measured, self.scaled, self.delay = motion, measured, scaled, delay
        self.names, self.joints = names, [motion.offsets.index(name) for name in names]
        F = motion.poses(np.zeros(len(motion.offsets)), 0.0)
        self.X, self.Y = closed_form(F, measured.start) if start is None else start
        sigmas = [CONSTANTS.pose_prior] * 12 + [CONSTANTS.offset_prior] * len(self.names)
        sigmas += [CONSTANTS.scale_prior] * scaled + [CONSTANTS.delay_prior] * (delay is not None)
        self.prior = 1.0 / np.array(sigmas)

    def scale(self, x: Array) -> float:
        """Compute the scale [1] of the board or map."""
        return float(np.exp(x[12 + len(self.names)])) if self.scaled else 1.0

    def predict(self, x: Array) -> Array:
        """Compute the poses Y⁻¹ F X (V, 4, 4) in the lengths of the board or map."""
        offsets = np.zeros(len(self.motion.offsets))
        offsets[self.joints] = x[12 : 12 + len(self.names)]
        F = self.motion.poses(offsets, 0.0 if self.delay is None else float(x[-1]))
        T = np.asarray(inverse(self.Y @ se3_exp(x[6:12])) @ F @ (self.X @ se3_exp(x[:6])))
        T[:, :3, 3] /= self.scale(x)
        return T

    def solve(self) -> Array:
        """Return the solution; the standard deviations of the measurement follow its errors."""
        x = np.zeros(len(self.prior))
        for _ in range(CONSTANTS.rounds):
            before, x = x, np.asarray(least_squares(self._residuals, x, **_LOSS).x)
            self.measured = self.measured.scaled(self.measured.residuals(self.predict(x)))
            if np.abs(x - before).max() < 1e-7:
                break
        return x

    def _residuals(self, x: Array) -> Array:
        return np.concatenate([*self.measured.residuals(self.predict(x)), self.prior * x])

    def covariance(self, x: Array, considered: tuple[str, ...]) -> Array:
        """Compute the covariance of the unknowns.

        The errors of one view are not independent, because the arm and the tracking err for the whole view. The
        delete-one-block jackknife (Efron 1982), linearized at the solution, needs no model of them:
        (B - 1)/B Σ d_b d_bᵀ with d_b = (H - H_b)⁻¹ g_b / m. Here m is the mean of ψ'(r) over that of ψ(r)/r, because H
        of Huber's loss has the weights ψ(r)/r (Huber 1981, section 7.6). ``considered`` offsets are 0 in the solution:
        K σ² Kᵀ with K = H⁻¹ H_kc adds the effect of their unknown values (Schmidt-Kalman).
        """
        sizes = [len(r) for r in self.measured.residuals(self.predict(x))]
        names, start = (*self.names, *considered), (self.X, self.Y)
        wide = _Model(self.motion, self.measured, names, self.scaled, self.delay, start=start)
        split = 12 + len(self.names)
        added = np.arange(split, split + len(considered))
        found = least_squares(wide._residuals, np.insert(x, split, np.zeros(len(considered))), max_nfev=1)
        size = np.maximum(np.abs(found.fun), 1e-300)
        weights = np.minimum(1.0, CONSTANTS.huber / size)
        J, r = found.jac * np.sqrt(weights)[:, None], found.fun * np.sqrt(weights)
        data = slice(0, sum(sizes))
        share = float((size[data] <= CONSTANTS.huber).mean()) / float(weights[data].mean())
        every = J.T @ J
        kept = np.setdiff1d(np.arange(len(every)), added)
        H = every[np.ix_(kept, kept)]
        edges = np.concatenate([[0], np.cumsum(sizes)])
        blocks = np.array_split(np.arange(len(sizes)), min(len(sizes), CONSTANTS.blocks))
        steps = []
        for views in blocks:
            part = J[edges[views[0]] : edges[views[-1] + 1]][:, kept]
            g = part.T @ r[edges[views[0]] : edges[views[-1] + 1]]
            steps.append(_inverse(H - part.T @ part) @ g / max(share, CONSTANTS.least_share))
        K = CONSTANTS.offset_prior * _inverse(H) @ every[np.ix_(kept, added)]
        jackknife = (len(blocks) - 1) / len(blocks) * np.transpose(steps) @ np.array(steps)
        return np.asarray(_inverse(H) + jackknife + K @ K.T)

    def result(
        self,
        x: Array,
        held_out: dict[HandEyeUnknowns, float],
        refused: dict[str, Estimate],
        refused_scale: Estimate | None,
    ) -> HandEyeCalibration:
        """Return the calibration of a solution; ``refused`` offsets are 0 in it, and a refused scale is 1."""
        covariance = self.covariance(x, tuple(refused))
        sigma = np.sqrt(np.diag(covariance))
        need = "move the other joints more, or this one with the camera close to the target"
        limit, units = CONSTANTS.largest_offset_sigma, dict(zip(self.motion.offsets, self.motion.units, strict=True))
        offsets = {
            name: Estimate.limited(float(x[12 + k]), float(sigma[12 + k]), units[name], limit, need)
            for k, name in enumerate(self.names)
        }
        if offsets or refused:
            first, *_, last = self.motion.offsets
            ends = [
                Estimate(0.0, CONSTANTS.offset_prior, units[name], reason)
                for name, reason in zip((first, last), UNKNOWABLE, strict=True)
            ]
            every = {first: ends[0], **offsets, **refused, last: ends[1]}
            offsets = {name: every[name] for name in self.motion.offsets}
        scale, delay = refused_scale, None
        if self.scaled:
            s, need = self.scale(x), "shift the camera more, in all directions"
            scale = Estimate.limited(s, s * float(sigma[12 + len(self.names)]), "", CONSTANTS.largest_scale_sigma, need)
        if self.delay is not None:
            need = "move faster and in all directions"
            value = self.delay + float(x[-1])
            delay = Estimate.limited(value, float(sigma[-1]), "s", CONSTANTS.largest_delay_sigma, need)
        return HandEyeCalibration(
            self.X @ se3_exp(x[:6]),
            self.Y @ se3_exp(x[6:12]),
            covariance[:6, :6],
            covariance[6:12, 6:12],
            offsets,
            scale,
            delay,
            self.measured.error(self.measured.residuals(self.predict(x))),
            self.measured.largest_error,
            held_out,
            self.measured.unit,
            len(self.motion),
        )


def _inverse(H: Array) -> Array:
    """Compute the inverse of a positive semidefinite matrix; undetermined values get a huge variance."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    return np.asarray(scale[:, None] * np.linalg.inv(scale[:, None] * H * scale + 1e-12 * np.eye(len(H))) * scale)


def closed_form(T_base_link: Array, T_static_moving: Array) -> tuple[Array, Array]:
    """Compute X and Y of F_k X = Y C_k (Park and Martin, Robot sensor calibration: solving AX = XB, 1994).

    Pairs of views give A X = X B with A = F_i⁻¹ F_j and B = C_i⁻¹ C_j. The rotation of X turns the rotation vectors of
    B into those of A (orthogonal Procrustes). Its translation solves (R_A - I) t_X = R_X t_B - t_A.

    Args:
        T_base_link: (V, 4, 4) poses F.
        T_static_moving: (V, 4, 4) poses C.

    Raises:
        InputError: the rotations of the link are about one axis only.
    """
    V = len(T_base_link)
    i, j = np.triu_indices(V, 1)
    if len(i) > 4000:  # enough to average the noise; all pairs of a long log need gigabytes
        chosen = np.random.default_rng(0).choice(len(i), 4000, replace=False)
        i, j = i[chosen], j[chosen]
    A, B = _relative(T_base_link, i, j), _relative(T_static_moving, i, j)
    alpha, beta = (Rotation.from_matrix(M[:, :3, :3]).as_rotvec() for M in (A, B))
    safe = np.linalg.norm(alpha, axis=1) < 3.0  # near π the axis may point either way
    spread = np.linalg.svd(alpha[safe], compute_uv=False) / np.sqrt(max(1, int(safe.sum())))
    if len(spread) < 2 or spread[1] < CONSTANTS.least_turn:
        turn = 0.0 if len(spread) < 2 else np.degrees(spread[1])
        raise InputError(
            f"turns about one axis only: {turn:.1f} degrees about others.",
            field="motion",
            hint="turn the link about two axes or more between the views, by 20 degrees or more",
        )
    R = nearest_rotation(alpha[safe].T @ beta[safe])
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ R.T - A[:, :3, 3]).reshape(-1)
    X, Y = np.eye(4), np.eye(4)
    X[:3, :3], X[:3, 3] = R, np.linalg.lstsq(left, right, rcond=None)[0]
    found = T_base_link @ X @ np.stack([inverse(T) for T in T_static_moving])
    Y[:3, :3], Y[:3, 3] = nearest_rotation(found[:, :3, :3].sum(axis=0)), np.median(found[:, :3, 3], axis=0)
    return X, Y


def _relative(T: Array, i: NDArray[np.intp], j: NDArray[np.intp]) -> Array:
    """Compute T_i⁻¹ T_j (P, 4, 4) of rigid transforms."""
    out = np.tile(np.eye(4), (len(i), 1, 1))
    R = T[i, :3, :3].transpose(0, 2, 1)
    out[:, :3, :3] = R @ T[j, :3, :3]
    out[:, :3, 3] = np.einsum("nij,nj->ni", R, T[j, :3, 3] - T[i, :3, 3])
    return out
