"""The target detector: an image in, the target's position with its covariance out, or the reason why not."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.frames import R_CB_NOMINAL
from vision.area import SCALES, fit_area
from vision.camera import Camera, check_rotation
from vision.candidates import Candidate, Search
from vision.engine import engine_of
from vision.fix import NoFix, VisionFix
from vision.judge import beyond_doubt, clearly_better, doubtful, inside_more, judge_area, judge_profiles, rank
from vision.lines import edges_of, usable_edges
from vision.plane import LevelPlane, rotation_vector_xy, rotation_xy
from vision.position import Positions
from vision.refine import Fit, fit_profiles
from vision.rings import Hypothesis
from vision.target import RingTarget
from vision.thesis import thesis_detect

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

AUTO_TILT_SIGMA_RAD = 0.14
"""Prior of the deck's tilt when an image contradicts a level deck."""
FREE_TILT_SIGMA_RAD = 0.6
"""Prior of the plane's tilt about the one that an ellipse gave, where no attitude is known."""
THESIS_RELATIVE_SIGMA = 0.07
"""1-sigma per axis of a fix by the thesis's method, as a share of the distance (its reported errors: 6-8
%)."""
MIN_DIAMETER_PX = 7.0
"""Outer diameter below which nothing can be told from a red spot."""
SMALL_PX = 80.0
"""Outer diameter below which all pixels of the target are fitted where its edges could not be."""
MAX_FITS = 16
MAX_AREA_FITS = 6
"""Limits of the work spent on one image."""


class TargetDetector:
    """Finds a ring target in images of one camera.

    Parameters
    ----------
    camera, target
        What looks, and what is looked for.
    method
        ``"rings"``, or ``"thesis"`` for seed chapter 4 as it was written (``vision.thesis``).
    attitude_sigma_rad
        1-sigma error of ``R_nc`` about each axis. It widens the prior of the relative tilt, and the
        covariance by ``sigma^2 [P]x [P]x'``: the error that the fix gets when it is rotated to NED by the
        same ``R_nc``. A filter that carries the attitude's error itself leaves this at zero and states
        ``deck_tilt_sigma_rad``.
    deck_tilt_sigma_rad
        1-sigma tilt of the deck about each level axis. Zero: the deck is taken as level (seed 3) unless the
        image contradicts it clearly.
    focal_sigma
        Relative 1-sigma error of the focal length.
    principal_point_sigma_px
        1-sigma error of the principal point.
    model_error_px
        1-sigma error of the model of an edge, which moves all edges outwards alike and so enters the range only;
        what moves them sideways is the principal point's. The default is what is left on pictures without noise of
        targets of 25 to 35 px, by two renderers.
    R_cb
        Body to camera, shape (3, 3); used only to turn ``body_rate_radps`` for rolling shutters.
    min_share
        Least share of the visible edge length that has to agree with the model.
    engine
        ``"compiled"`` (needs numba), ``"numpy"``, or ``"auto"``: compiled where numba is installed. The fixes
        are the same; compiled, they take a fraction of the time, but the very first detector on a machine
        waits a minute or two for the compiler (the result is kept in the user's cache folder).

    Raises ``ValueError`` naming the argument.
    """

    def __init__(
        self,
        camera: Camera,
        target: RingTarget,
        *,
        method: str = "rings",
        attitude_sigma_rad: float = 0.0,
        deck_tilt_sigma_rad: float = 0.0,
        focal_sigma: float = 0.0,
        principal_point_sigma_px: float = 0.0,
        model_error_px: float = 0.0003,
        R_cb: ArrayLike = R_CB_NOMINAL,
        min_share: float = 0.55,
        engine: str = "auto",
    ) -> None:
        if not isinstance(camera, Camera):
            raise ValueError(f"camera: a {type(camera).__name__}, not a vision.Camera")
        if not isinstance(target, RingTarget):
            raise ValueError(f"target: a {type(target).__name__}, not a vision.RingTarget")
        if method not in ("rings", "thesis"):
            raise ValueError(f"method: {method!r} is neither 'rings' nor 'thesis'")
        self.camera = camera
        self.target = target
        self.method = method
        self.attitude_sigma_rad = _sigma("attitude_sigma_rad", attitude_sigma_rad, 1.0)
        self.deck_tilt_sigma_rad = _sigma("deck_tilt_sigma_rad", deck_tilt_sigma_rad, 1.0)
        self.focal_sigma = _sigma("focal_sigma", focal_sigma, 0.5)
        self.principal_point_sigma_px = _sigma("principal_point_sigma_px", principal_point_sigma_px, 1e3)
        self.model_error_px = _sigma("model_error_px", model_error_px, 10.0)
        self.min_share = _sigma("min_share", min_share, 1.0)
        self._R_cb = check_rotation(R_cb, "R_cb")
        self._edges = np.asarray(target.edges_m, dtype=np.float64)
        self._edge_table = edges_of(self._edges)
        self._margin_m = 0.5 * target.side_m - self._edges[0]
        self._engine = engine_of(engine)
        self._places = Search(camera, self._edges, self._engine.label)
        self._positions = Positions(
            self._edge_table,
            self.attitude_sigma_rad,
            self.focal_sigma,
            self.principal_point_sigma_px,
            self.model_error_px,
        )

    def detect(
        self,
        image_bgr: Image,
        R_nc: ArrayLike | None = None,
        prior: VisionFix | ArrayLike | None = None,
        body_rate_radps: ArrayLike | None = None,
    ) -> VisionFix | NoFix:
        """Return the fix of one image, or why there is none.

        Parameters
        ----------
        image_bgr
            (height, width, 3) uint8, contiguous, as OpenCV reads it.
        R_nc
            Camera to NED, shape (3, 3), at the image's time. Without it the plane is found from the rings'
            shape, with a wider covariance.
        prior
            Where the target is expected, P^c [m], or the last fix; it is tried first and saves the search.
        body_rate_radps
            Angular velocity of the body (FRD), used for cameras with a read-out time.

        Raises ``ValueError`` naming the argument that is wrong.
        """
        image = self.camera.check_image(image_bgr)
        rotation = None if R_nc is None else check_rotation(R_nc, "R_nc")
        rate = None
        if body_rate_radps is not None:
            rate_body = _vector("body_rate_radps", body_rate_radps)
            if self.camera.readout_s > 0.0:
                rate = self._R_cb @ rate_body
        if self.method == "thesis":
            return self._thesis(image, rotation)
        if prior is not None:
            fix = self._track(image, rotation, prior, rate)
            if fix is not None:
                return fix
        return self._search(image, rotation, rate)

    def _thesis(self, image: Image, rotation: Array | None) -> VisionFix | NoFix:
        """Return the fix of seed chapter 4; it has no covariance of its own, so that it gets its reported
        error."""
        result = thesis_detect(self.camera, self.target, image, rotation)
        position = result.position_cam_m
        if position is None:
            return NoFix(result.reason)
        sigma = THESIS_RELATIVE_SIGMA * float(np.linalg.norm(position))
        points = np.concatenate([np.asarray(c).reshape(-1, 2) for c in result.contours]).astype(np.float64)
        return VisionFix(
            position,
            np.eye(3) * sigma**2,
            tuple(range(len(result.contours))),
            float("nan"),
            1.0,
            float("nan"),
            "thesis",
            np.eye(3) if rotation is None else rotation,
            None,
            points,
            np.ones(len(points), dtype=np.bool_),
        )

    def _track(
        self, image: Image, rotation: Array | None, prior: VisionFix | ArrayLike, rate: Array | None
    ) -> VisionFix | None:
        expected = _position(prior)
        last = prior.rotation if isinstance(prior, VisionFix) else None
        tilt = np.zeros(2)
        if rotation is None:
            if last is None:
                return None
            plane = LevelPlane(self.camera, last, rate)
        else:
            plane = LevelPlane(self.camera, rotation, rate)
            if isinstance(prior, VisionFix) and prior.tilt_rad is not None:
                tilt = prior.tilt_rad
                plane = plane.tilted(rotation_xy(tilt[0], tilt[1]))
        p = plane.rotation @ expected
        if not p[2] > 0.0:
            return None
        candidate = Candidate(Hypothesis(p[:2] / p[2], 1.0 / float(p[2]), (), 1.0), plane, tilt)
        left = {"fits": 1, "area": 1}
        fit = self._fit(image, candidate, rotation is None, left, scales=(1.0,))
        return None if isinstance(fit, str) else self._fix([fit], rotation, "tracked")

    def _search(self, image: Image, rotation: Array | None, rate: Array | None) -> VisionFix | NoFix:
        reason = "no red region of the target's kind"
        left = {"fits": MAX_FITS, "area": MAX_AREA_FITS}
        for contours in self._places.contour_sets(image):
            for candidates in self._places.candidates(contours, rotation, rate):
                accepted: list[Fit] = []
                for candidate in candidates:
                    fit = self._fit(image, candidate, rotation is None, left)
                    if isinstance(fit, str):
                        reason = fit or reason
                        continue
                    if not (fit.share > 0.95 and 0 in fit.edges and not fit.is_area) and inside_more(
                        image, fit, self._edges[0]
                    ):
                        reason = "rings, but with more red rings around them"
                        continue
                    accepted.append(fit)
                    if rotation is not None and beyond_doubt(fit):
                        break
                if accepted:
                    return self._fix(accepted, rotation, "found")
            if len(contours) and reason.startswith("no red"):
                reason = "red regions, but no concentric rings of the target's ratios"
        return NoFix(reason)

    def _fit(
        self,
        image: Image,
        candidate: Candidate,
        free: bool,
        left: dict[str, int],
        scales: tuple[float, ...] = SCALES,
    ) -> Fit | str:
        """Fit a candidate and judge it: the fit, or the reason why it is none.

        ``left`` counts down what may still be tried on this image; where nothing is left the reason is empty.
        ``scales`` are tried around a small target's, relative to the candidate's.
        """
        plane, hypothesis = candidate.plane, candidate.hypothesis
        unit = float(plane.units_per_pixel(hypothesis.centre[0], hypothesis.centre[1]))
        to_px = hypothesis.kappa / unit
        usable = usable_edges(self._edge_table, to_px, 0.0)
        sigma = (
            FREE_TILT_SIGMA_RAD
            if free
            else float(np.hypot(self.attitude_sigma_rad, self.deck_tilt_sigma_rad))
        )
        if usable.sum() < min(3, len(self._edges)):
            return self._fit_small(image, candidate, sigma, left, scales)
        if left["fits"] <= 0:
            return ""
        left["fits"] -= 1

        def fit_with(tilt_sigma_rad: float) -> Fit | None:
            return fit_profiles(
                image,
                plane,
                hypothesis.centre,
                hypothesis.kappa,
                self._edge_table,
                tilt_sigma_rad=tilt_sigma_rad,
                tilt=candidate.tilt,
                solver=self._engine.solve,
            )

        fit = fit_with(sigma or (AUTO_TILT_SIGMA_RAD if candidate.tilt.any() else 0.0))
        if sigma == 0.0 and not candidate.tilt.any() and doubtful(fit):
            # Does the image contradict a level deck?
            tilted = fit_with(AUTO_TILT_SIGMA_RAD)
            if tilted is not None and (fit is None or clearly_better(tilted, fit)):
                fit = tilted
        judged = judge_profiles(fit, self.min_share)
        if isinstance(judged, str) and 2.0 * self._edges[0] * to_px < SMALL_PX:
            small = self._fit_small(image, candidate, sigma, left, scales)
            return judged if isinstance(small, str) else small
        return judged

    def _fit_small(
        self,
        image: Image,
        candidate: Candidate,
        tilt_sigma_rad: float,
        left: dict[str, int],
        scales: tuple[float, ...],
    ) -> Fit | str:
        """Fit all pixels of a small target: in one light first, then with a light for each sector."""
        if left["area"] <= 0:
            return ""
        hypothesis = candidate.hypothesis
        unit = float(candidate.plane.units_per_pixel(hypothesis.centre[0], hypothesis.centre[1]))
        if 2.0 * self._edges[0] * hypothesis.kappa / unit < MIN_DIAMETER_PX:
            return f"a red spot below {MIN_DIAMETER_PX:g} px"
        left["area"] -= 1
        # Beyond this blur nothing of the rings is left.
        max_blur_px = 0.8 * float(np.max(-np.diff(self._edges))) * hypothesis.kappa / unit
        best: Fit | None = None
        reason = ""
        for sectors in (1, 8):
            fit = fit_area(
                image,
                candidate.plane,
                hypothesis.centre,
                hypothesis.kappa,
                self._edge_table,
                margin_m=self._margin_m,
                tilt_sigma_rad=tilt_sigma_rad,
                sectors=sectors,
                scales=scales,
                solver=self._engine.area,
            )
            judged = judge_area(fit, sectors > 1, self.min_share, max_blur_px)
            if isinstance(judged, str):
                reason = reason or judged
            elif 2.0 * self._edges[0] * judged.kappa / unit < MIN_DIAMETER_PX:
                reason = reason or f"a red spot below {MIN_DIAMETER_PX:g} px"
            elif best is None or judged.chi2 > best.chi2:
                best = judged
            if best is not None and best.chi2 > 8.0 and best.residual_px < 0.06:
                break
        return reason if best is None else best

    def _fix(self, fits: list[Fit], rotation: Array | None, how: str) -> VisionFix:
        best = max(fits, key=rank)
        position, covariance = self._positions.of(best, rotation is not None)
        if rotation is None:
            # Two planes see the same ellipse; where they fit equally well, either may be the right one.
            for other in fits:
                if other is not best and other.residual_px < 1.2 * best.residual_px:
                    d = self._positions.of(other, False)[0] - position
                    covariance = covariance + 0.5 * np.outer(d, d)
        tilt = None
        if rotation is not None and best.tilt_free:
            tilt = rotation_vector_xy(best.plane.rotation @ rotation.T)
        return VisionFix(
            position,
            covariance,
            best.edges,
            best.residual_px,
            best.share,
            best.blur_px,
            how,
            best.plane.rotation,
            tilt,
            best.points_px,
            best.agrees,
        )


def _sigma(name: str, value: float, limit: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {value!r} is not a number") from error
    if not 0.0 <= number <= limit:
        raise ValueError(f"{name}: {number!r} is not between 0 and {limit:g}")
    return number


def _vector(name: str, value: ArrayLike) -> Array:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: not an array of numbers") from error
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name}: not three finite numbers")
    return vector


def _position(prior: VisionFix | ArrayLike) -> Array:
    return prior.position_cam_m if isinstance(prior, VisionFix) else _vector("prior", prior)
