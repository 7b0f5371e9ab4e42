"""The topics of a log and the definitions of their messages.

Standard topics carry standard ROS 2 messages; ``deckfix_msgs`` are defined here and in each file, so that any
ROS 2 tool shows them. The columns of a topic (``row_dtype``) are the message without its header and strings:

============================ ===========================================================================
/imu                         orientation (4: x y z w), orientation_covariance (9), angular_velocity (3),
                             angular_velocity_covariance (9), linear_acceleration (3),
                             linear_acceleration_covariance (9); orientation_covariance[0] = -1: none given
/gps/fix                     status_status = fix type - 1 (-1 none, 0 fix, 1 RTK float, 2 RTK fixed),
                             status_service, latitude, longitude [deg], altitude [m, above the ellipsoid],
                             position_covariance (9, ENU), position_covariance_type (0: none given)
/gps/velocity                twist_twist_linear (3, NED), twist_twist_angular (3), twist_covariance (36)
/baro, /baro/temperature     fluid_pressure [Pa], variance; temperature [deg C], variance
/magnetic_field              magnetic_field (3) [T], magnetic_field_covariance (9)
/range                       radiation_type, field_of_view, min_range, max_range, range (float32)
/attitude                    quaternion (4: x y z w), body (FRD) to NED
/vision/fix                  pose_pose_position (3), pose_pose_orientation (4), pose_covariance (36)
/timesync                    sent_ns, remote_ns, received_ns (int64)
odometry topics              pose_pose_position, pose_pose_orientation, pose_covariance (36),
                             twist_twist_linear, twist_twist_angular, twist_covariance (36)
/heave/model                 level_m, level_sigma_m, significant_height_m, peak_period_s, amplitude_m (k),
                             period_s (k), phase_rad (k); up, t = 0 at the stamp
/heave/forecast              horizon_s (h), heave_m (h), heave_sigma_m (h), rate_mps (h), rate_sigma_mps (h),
                             skill (h), fallback (h), window_probability (h), window_rate_mps, window_s
============================ ===========================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimation.modes import Mode
from estimation.outcome import EXPLANATIONS, Outcome
from logs.cdr import Given, layout
from logs.definition import Definition, parse, short_name

_HEADER = "std_msgs/Header header\n"
_MODES = "".join(f"uint8 {m.name}={m.value}\n" for m in Mode)
_OUTCOMES = "".join(f"uint8 {o.name}={o.value}  # {EXPLANATIONS[o]}\n" for o in Outcome)

_BODIES: Mapping[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation\n",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/PoseWithCovarianceStamped": _HEADER + "PoseWithCovariance pose\n",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovarianceStamped": _HEADER + "TwistWithCovariance twist\n",
    "geometry_msgs/QuaternionStamped": _HEADER + "Quaternion quaternion\n",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation\n",
    "geometry_msgs/TransformStamped": _HEADER + "string child_frame_id\nTransform transform\n",
    "nav_msgs/Odometry": _HEADER
    + "string child_frame_id\n"
    + "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
    "sensor_msgs/Imu": _HEADER
    + "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    + "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    + "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    "sensor_msgs/NavSatStatus": "int8 STATUS_UNKNOWN=-2\nint8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\n"
    + "int8 STATUS_SBAS_FIX=1\nint8 STATUS_GBAS_FIX=2\nint8 status -2\n"
    + "uint16 SERVICE_UNKNOWN=0\nuint16 SERVICE_GPS=1\nuint16 SERVICE_GLONASS=2\n"
    + "uint16 SERVICE_COMPASS=4\nuint16 SERVICE_GALILEO=8\nuint16 service\n",
    "sensor_msgs/NavSatFix": _HEADER
    + "NavSatStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n"
    + "float64[9] position_covariance\nuint8 COVARIANCE_TYPE_UNKNOWN=0\n"
    + "uint8 COVARIANCE_TYPE_APPROXIMATED=1\nuint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\n"
    + "uint8 COVARIANCE_TYPE_KNOWN=3\nuint8 position_covariance_type\n",
    "sensor_msgs/FluidPressure": _HEADER + "float64 fluid_pressure\nfloat64 variance\n",
    "sensor_msgs/Temperature": _HEADER + "float64 temperature\nfloat64 variance\n",
    "sensor_msgs/MagneticField": _HEADER
    + "geometry_msgs/Vector3 magnetic_field\nfloat64[9] magnetic_field_covariance\n",
    "sensor_msgs/Range": _HEADER
    + "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nuint8 radiation_type\nfloat32 field_of_view\n"
    + "float32 min_range\nfloat32 max_range\nfloat32 range\n",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
    + "bool do_rectify\n",
    "sensor_msgs/CameraInfo": _HEADER
    + "uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\n"
    + "float64[12] p\nuint32 binning_x\nuint32 binning_y\nRegionOfInterest roi\n",
    "sensor_msgs/CompressedImage": _HEADER + "string format\nuint8[] data\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "rcl_interfaces/Log": "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
    + "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\n"
    + "uint32 line\n",
    "deckfix_msgs/TimeSync": "# One exchange between two clocks, all readings raw.\n"
    + _HEADER
    + "string reference_clock  # the clock of sent_ns and received_ns\n"
    + "int64 sent_ns\nint64 remote_ns  # reading of the other clock, in between\nint64 received_ns\n",
    "deckfix_msgs/UserMeasurement": "# A measurement of a sensor defined by the user.\n"
    + _HEADER
    + "string sensor\nfloat64[] value\nfloat64[] covariance  # upper triangle by rows; empty: none\n",
    "deckfix_msgs/FilterState": "# Every state of the filter with its standard deviation (SI units, rad).\n"
    + _HEADER
    + "string[] names\nfloat64[] values\nfloat64[] sigmas\n",
    "deckfix_msgs/FusionReport": "# What became of one measurement.\n"
    + _HEADER
    + "string sensor\n"
    + _OUTCOMES
    + "uint8 outcome\nfloat64 nis  # normalised innovation squared; NaN where none was formed\nuint8 dof\n"
    + "float64[3] innovation\nfloat64[3] sigma  # of the innovation; NaN beyond dof\n"
    + "float64 age_s  # time of the filter less time of the content\n",
    "deckfix_msgs/HeaveModel": "# Heave of the deck, up: level + sum of A sin(2 pi t / T + phi), t from the stamp on.\n"
    + _HEADER
    + "string method  # bhr: a learned spectrum; sinusoids; mean: the level only\n"
    + "float64 level_m  # above the origin, drift included, at the stamp\nfloat64 level_sigma_m\n"
    + "float64 significant_height_m\nfloat64 peak_period_s\n"
    + "float64[] amplitude_m\nfloat64[] period_s\nfloat64[] phase_rad\n",
    "deckfix_msgs/HeaveForecast": "# Heave and heave rate (up) at each horizon from the stamp on.\n"
    + _HEADER
    + "float64[] horizon_s\nfloat64[] heave_m  # above the origin, level included\n"
    + "float64[] heave_sigma_m\nfloat64[] rate_mps\nfloat64[] rate_sigma_mps\n"
    + "float64[] skill  # 1 - variance / variance of the mean predictor\n"
    + "uint8[] fallback  # 1: no better than the level, which is given instead\n"
    + "float64[] window_probability  # of a quiescent window that begins there\n"
    + "float64 window_rate_mps  # quiet: the rate stays below this\nfloat64 window_s  # for so long\n",
    "deckfix_msgs/LandingMode": "# What the landing is at, why, and the velocity that it asks for.\n"
    + _HEADER
    + _MODES
    + "uint8 mode\nstring reason  # what led to the mode\n"
    + "geometry_msgs/Point setpoint  # place aimed at, relative to the platform, NED [m]\n"
    + "geometry_msgs/Vector3 velocity  # asked for, NED [m/s]\nfloat64 setpoint_yaw_rad\n"
    + "float64 inside_probability  # of being inside the circle that counts; NaN where none does\n"
    + "float64 quiet_probability  # of a quiet deck at contact; NaN where it is not asked\n",
}

_RULE = "=" * 80


@lru_cache(maxsize=64)
def definition_text(message_type: str) -> str:
    """Return the concatenated ``ros2msg`` definition of a message type, dependencies included.

    Raises:
        KeyError: the type is not among those that deckfix writes.
    """
    root = short_name(message_type)
    order: list[str] = []

    def visit(name: str) -> None:
        if name in order:
            return
        order.append(name)
        package = name.split("/", maxsplit=1)[0]
        for line in _BODIES[name].splitlines():
            kind = line.split("#")[0].split("[")[0].split(" ")[0]
            if kind[:1].isupper():
                kind = f"{package}/{kind}"
            if "/" in kind:
                visit(kind)

    visit(root)
    dependencies = "".join(f"{_RULE}\nMSG: {name}\n{_BODIES[name]}" for name in order[1:])
    return _BODIES[root] + dependencies


def definition(message_type: str) -> Definition:
    """Return the parsed definition of a message type that deckfix writes."""
    return parse(message_type, definition_text(message_type))


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic, its message type (``package/msg/Type``), and the frame and strings it usually has."""

    name: str
    message_type: str
    frame_id: str = ""
    strings: Mapping[str, str] = field(default_factory=dict)

    @property
    def definition(self) -> str:
        """Concatenated ``ros2msg`` definition."""
        return definition_text(self.message_type)


_BODY = {"child_frame_id": "base_link_frd"}
_DECK = {"child_frame_id": "platform"}
_ODOMETRY = "nav_msgs/msg/Odometry"

TOPICS: Mapping[str, Topic] = {
    topic.name: topic
    for topic in (
        Topic("/imu", "sensor_msgs/msg/Imu", "base_link_frd"),
        Topic("/gps/fix", "sensor_msgs/msg/NavSatFix", "gps"),
        Topic("/gps/velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", "ned"),
        Topic("/baro", "sensor_msgs/msg/FluidPressure", "base_link_frd"),
        Topic("/baro/temperature", "sensor_msgs/msg/Temperature", "base_link_frd"),
        Topic("/magnetic_field", "sensor_msgs/msg/MagneticField", "base_link_frd"),
        Topic("/range", "sensor_msgs/msg/Range", "rangefinder"),
        Topic("/attitude", "geometry_msgs/msg/QuaternionStamped", "ned"),
        Topic("/user", "deckfix_msgs/msg/UserMeasurement", "base_link_frd"),
        Topic("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", "camera", {"format": "jpeg"}),
        Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", "camera"),
        Topic("/vision/fix", "geometry_msgs/msg/PoseWithCovarianceStamped", "camera"),
        Topic("/timesync", "deckfix_msgs/msg/TimeSync", "", {"reference_clock": "companion"}),
        Topic("/estimate/odometry", _ODOMETRY, "ned", _BODY),
        Topic("/estimate/relative", _ODOMETRY, "platform", _BODY),
        Topic("/estimate/platform", _ODOMETRY, "ned", _DECK),
        Topic("/estimate/state", "deckfix_msgs/msg/FilterState", "ned"),
        Topic("/smoothed/odometry", _ODOMETRY, "ned", _BODY),
        Topic("/smoothed/relative", _ODOMETRY, "platform", _BODY),
        Topic("/smoothed/platform", _ODOMETRY, "ned", _DECK),
        Topic("/fusion", "deckfix_msgs/msg/FusionReport"),
        Topic("/heave/model", "deckfix_msgs/msg/HeaveModel", "ned", {"method": "bhr"}),
        Topic("/heave/forecast", "deckfix_msgs/msg/HeaveForecast", "ned"),
        Topic("/landing/mode", "deckfix_msgs/msg/LandingMode", "platform"),
        Topic("/truth/odometry", _ODOMETRY, "ned", _BODY),
        Topic("/truth/platform", _ODOMETRY, "ned", _DECK),
        Topic("/autopilot/odometry", _ODOMETRY, "ned", _BODY),
        Topic("/tf_static", "tf2_msgs/msg/TFMessage"),
        Topic("/log", "rcl_interfaces/msg/Log"),
    )
}
"""Every topic that deckfix writes, by name."""


@lru_cache(maxsize=256)
def row_dtype(topic_or_type: str, **lengths: int) -> np.dtype[np.void]:
    """Return the columns of a topic's (or a message type's) messages, native and packed.

    ``lengths`` gives the lengths of sequences by their path, for example ``values=15``; others are empty.

    Raises:
        KeyError: neither a topic nor a message type that deckfix writes.
    """
    topic = TOPICS.get(topic_or_type)
    message = definition(topic.message_type if topic else topic_or_type)
    return layout(message, Given(lengths=lengths)).row_dtype


def new_rows(topic_or_type: str, n: int, **lengths: int) -> NDArray[np.void]:
    """Return n rows of ``row_dtype``, filled with zeros."""
    return np.zeros(n, dtype=row_dtype(topic_or_type, **lengths))
