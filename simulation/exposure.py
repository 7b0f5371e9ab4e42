"""A picture of one moment of a flight: what the camera on the vehicle sees of the deck, compressed as a camera does."""

from __future__ import annotations

import numpy as np

from estimation.frames import R_CB_NOMINAL, Array, euler_to_quat, quat_exp, quat_to_matrix
from estimation.sensor_config import VisionConfig
from simulation.flight import deck_axes
from simulation.instruments import Instant
from simulation.mission import Mission
from simulation.renderer import Renderer, Scene
from vision.camera import Camera
from vision.target import RingTarget

CAMERA = "rpi-v2-640x480"
JPEG_QUALITY = 90


def renderer_of(mission: Mission) -> Renderer:
    """Return what renders a mission's target on its deck, through the camera ``CAMERA``."""
    target = RingTarget.recommended(mission.target_m)
    return Renderer(Camera.preset(CAMERA), target, Scene(deck_m=max(mission.deck_m, target.side_m)))


def expose(
    renderer: Renderer, config: VisionConfig, now: Instant, rng: np.random.Generator, mount_rad: Array
) -> bytes | None:
    """Return a moment's picture as JPEG, or None where the camera is not above the deck.

    ``config`` says how the camera is mounted, ``mount_rad`` (3,) is the error of that: as in ``simulation.fixes``, the
    camera sees ``P^c = R_cb exp(m)' (R_nb' (P_platform - P) - l)``.
    """
    import cv2

    mount = quat_to_matrix(quat_exp(mount_rad)) @ quat_to_matrix(euler_to_quat(*config.mount_rpy_rad))
    R_bc = mount @ R_CB_NOMINAL.T
    place = now.position_m + now.R_nb @ np.array(config.lever_arm_m) - now.deck_m
    deck: Array = deck_axes(now.deck_normal[None])[0]
    try:
        image = renderer.render(
            now.R_nb @ R_bc, place, rng, R_nd=deck, rate_c_radps=R_bc.T @ now.angular_velocity_radps
        )
    except ValueError:
        return None
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data) if done else None
