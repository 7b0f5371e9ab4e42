"""Configuration of the sensors: noise, mounting, latency; the simulator draws its sensors from the same numbers."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from estimation.config_fields import Table, Vector3, choice, not_negative, number, positive


class ImuConfig(Table, frozen=True):
    """Inertial sensor. Also what the simulator draws its IMU from."""

    accel_noise: Annotated[
        float,
        positive(
            "white noise of specific force; 0.01 means 0.01 m/s after 1 s, 0.03 m/s after 10 s", "m/s^2/rtHz"
        ),
    ] = 0.01
    gyro_noise: Annotated[
        float,
        positive(
            "white noise of angular velocity; 5e-4 means 0.03 deg after 1 s, 0.09 deg after 10 s",
            "rad/s/rtHz",
        ),
    ] = 5e-4
    accel_bias_walk: Annotated[
        float,
        not_negative("random walk of the accelerometer bias; 5e-4: 1.6 mm/s^2 after 10 s", "m/s^2/rts"),
    ] = 5e-4
    gyro_bias_walk: Annotated[
        float, not_negative("random walk of the gyro bias; 9e-5: 0.016 deg/s after 10 s", "rad/s/rts")
    ] = 9e-5
    accel_bias_sigma: Annotated[
        float,
        positive("1-sigma of the accelerometer bias at start; it cannot be told from tilt in hover", "m/s^2"),
    ] = 0.03
    gyro_bias_sigma: Annotated[
        float, positive("1-sigma of the gyro bias at start when it was not averaged at rest", "rad/s")
    ] = 5e-3
    vibration_gain: Annotated[
        float,
        not_negative(
            "share of the measured sample-to-sample scatter that is added to the white noise (0: off). A vibrating "
            "airframe aliases into the specific force; 1 would take all of it as white",
            "-",
        ),
    ] = 0.02
    latency_s: Annotated[
        float | None,
        number("age of a sample at its stamp (filter delay); None: as the log says, else 0", "s"),
    ] = None
    gap_s: Annotated[
        float, positive("longest gap that is bridged; a longer one starts a new alignment", "s")
    ] = 3.0


class GpsConfig(Table, frozen=True):
    """GPS position and velocity."""

    latency_s: Annotated[float, not_negative("age of a fix at its stamp", "s")] = 0.105
    lever_arm_m: Annotated[Vector3, number("antenna relative to the IMU, body FRD", "m")] = (0.0, 0.0, 0.0)
    position_sigma_m: Annotated[
        float, positive("white horizontal noise where the receiver states none, and its floor", "m")
    ] = 0.1
    height_sigma_m: Annotated[
        float, positive("white vertical noise where the receiver states none, and its floor", "m")
    ] = 1.0
    velocity_sigma_mps: Annotated[
        float, positive("white horizontal velocity noise where none is stated, and its floor", "m/s")
    ] = 0.2
    climb_sigma_mps: Annotated[
        float, positive("white vertical velocity noise where none is stated, and its floor", "m/s")
    ] = 0.3
    white_fraction: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="share of the receiver's stated position accuracy that is white; the rest is slow and is "
            "what the bias states carry",
            extra={"unit": "-"},
        ),
    ] = 0.1
    bias: Annotated[bool, choice("carry a slowly wandering position error as a state")] = True
    bias_sigma_m: Annotated[float, positive("stationary 1-sigma of the horizontal position error", "m")] = 0.7
    height_bias_sigma_m: Annotated[
        float, positive("1-sigma of the vertical position error at start", "m")
    ] = 4.0
    bias_time_s: Annotated[float, positive("correlation time of the horizontal error", "s")] = 120.0
    height_bias_walk: Annotated[
        float,
        not_negative("random walk of the vertical error; 0.1: 0.1 m after 1 s, 0.3 m after 10 s", "m/rts"),
    ] = 0.1
    max_accuracy_m: Annotated[
        float, positive("a fix that states a worse horizontal accuracy is not used", "m")
    ] = 50.0
    rtk_accuracy_m: Annotated[
        float,
        not_negative(
            "an RTK fix that states a better accuracy than this is taken at its word (not below 0.3, in height 0.5 of "
            "this) and carries no wander; 0: never",
            "m",
        ),
    ] = 0.1
    reset_after_s: Annotated[
        float,
        positive(
            "fixes that agree with each other, but not with the filter, for this long move its position (never its "
            "attitude); a note says so",
            "s",
        ),
    ] = 5.0


class BarometerConfig(Table, frozen=True):
    """Barometric height; its offset is a state."""

    use: Annotated[bool, choice("fuse the barometer")] = True
    latency_s: Annotated[float, not_negative("age of a reading at its stamp", "s")] = 0.0
    sigma_m: Annotated[float, positive("white noise of the height", "m")] = 0.15
    bias_walk: Annotated[
        float, not_negative("random walk of the offset (weather); 0.01: 0.03 m after 10 s", "m/rts")
    ] = 0.01
    bias_sigma_m: Annotated[float, positive("1-sigma of the offset at start, once aligned", "m")] = 3.0


class MagnetometerConfig(Table, frozen=True):
    """Heading from the magnetic field."""

    use: Annotated[bool, choice("fuse the magnetometer's heading")] = True
    latency_s: Annotated[float, not_negative("age of a reading at its stamp", "s")] = 0.0
    heading_sigma_rad: Annotated[float, positive("1-sigma of the heading", "rad")] = 0.052
    declination_deg: Annotated[
        float | None,
        number("east positive; None: as the log says, else the World Magnetic Model", "deg"),
    ] = None


class AttitudeConfig(Table, frozen=True):
    """Attitude from the autopilot's own estimator."""

    use: Annotated[
        Literal["off", "initialise", "fuse"],
        choice("'initialise' only starts from it when the flight begins in the air"),
    ] = "initialise"
    latency_s: Annotated[float, not_negative("age of an attitude at its stamp", "s")] = 0.0
    tilt_sigma_rad: Annotated[float, positive("1-sigma of roll and pitch", "rad")] = 0.02
    yaw_sigma_rad: Annotated[float, positive("1-sigma of yaw", "rad")] = 0.1


class RangefinderConfig(Table, frozen=True):
    """Downward rangefinder over a surface of known height."""

    use: Annotated[bool, choice("fuse the rangefinder; needs a level surface below")] = False
    latency_s: Annotated[float, not_negative("age of a range at its stamp", "s")] = 0.0
    sigma_m: Annotated[float, positive("1-sigma at zero range", "m")] = 0.05
    sigma_per_m: Annotated[float, not_negative("growth of the 1-sigma with range", "-")] = 0.01
    lever_arm_m: Annotated[Vector3, number("sensor relative to the IMU, body FRD", "m")] = (0.0, 0.0, 0.0)
    surface_height_m: Annotated[float, number("height of the surface above the origin", "m")] = 0.0


class VisionConfig(Table, frozen=True):
    """Vision fixes of the target (P^c); used where the platform is."""

    latency_s: Annotated[
        float,
        Meta(
            ge=-0.03,
            le=0.15,
            description="age of a fix at its stamp, calibrated; below 0 where the map of the clocks sets it too early",
            extra={"unit": "s"},
        ),
    ] = 0.0
    latency_sigma_s: Annotated[
        float, positive("1-sigma of that age; the state that learns it stays within -0.03 to 0.15 s", "s")
    ] = 0.02
    arrival_latency_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.15,
            description="the same where the log says that fixes are stamped with their arrival: age at arrival",
            extra={"unit": "s"},
        ),
    ] = 0.06
    arrival_latency_sigma_s: Annotated[float, positive("1-sigma of that", "s")] = 0.05
    latency_walk: Annotated[
        float, not_negative("random walk of the age; 3e-5: 0.1 ms after 10 s", "s/rts")
    ] = 3e-5
    latency_rate_radps: Annotated[
        float,
        positive(
            "rotation (rms over 5 s, less noise) below which the age is not learned, only its doubt carried",
            "rad/s",
        ),
    ] = 0.035
    angle_sigma_rad: Annotated[
        float, positive("1-sigma across the line of sight, where a fix states no covariance", "rad")
    ] = 0.0035
    range_sigma: Annotated[
        float, positive("1-sigma along the line of sight as a share of the range, where none is stated", "-")
    ] = 0.01
    floor_m: Annotated[float, positive("1-sigma added to every fix, stated or not", "m")] = 0.01
    scale_sigma: Annotated[
        float, positive("1-sigma of the range scale (focal length, size of the target)", "-")
    ] = 0.005
    mount_sigma_rad: Annotated[
        float, positive("1-sigma of the camera's mounting; considered, never learned", "rad")
    ] = 0.005
    mount_rpy_rad: Annotated[
        Vector3, number("roll, pitch, yaw of the camera against looking straight down, top forward", "rad")
    ] = (0.0, 0.0, 0.0)
    lever_arm_m: Annotated[Vector3, number("camera relative to the IMU, body FRD", "m")] = (0.0, 0.0, 0.0)
