"""PX4 parameters on which a flight depends: the required value of each, and the consequence of any other value.

The rows of the preflight checks, `companion px4 params`, configs/px4/indoor_mocap.params, the table of docs/internals/px4.md and the
stub's settings come from this one table. Names, types, limits and whether a change needs a reboot are taken from the parameter
metadata of PX4 1.16.1 and 1.18; `companion.px4.versions` says which versions have a parameter.
"""

from __future__ import annotations

from functools import partial

from companion.config.vehicle import Vehicle
from companion.model.check_row import Level
from companion.model.constants import GRAVITY_M_S2, PX4_YAW_P
from companion.model.flight_stage import SPOOL_S
from companion.px4.wanted import Value, Wanted

HOVER = "MPC_THR_HOVER"
ROTOR_COUNT = "CA_ROTOR_COUNT"
RADIO = "COM_RC_IN_MODE"
NO_RADIO = 4
KILL_CHANNEL = "RC_MAP_KILL_SW"
"""Channel of the radio's kill switch; 0 if there is none."""
_HOVER_OFF_MAX = 0.35
_ROOM_MARGIN_M = 0.3
_FAILURE_MARGIN_DEG = 10.0


def _hover(vehicle: Vehicle) -> tuple[float, float]:
    airframe = vehicle.airframe
    expected = airframe.hover_thrust or airframe.mass_kg * GRAVITY_M_S2 / airframe.thrust_max_n
    return expected * (1.0 - _HOVER_OFF_MAX), expected * (1.0 + _HOVER_OFF_MAX)


def _rotors(vehicle: Vehicle) -> tuple[float, float]:
    count = float(vehicle.airframe.rotor_layout.count)
    return count, count


def _below_ceiling(vehicle: Vehicle) -> tuple[float, float]:
    return 0.0, max(0.0, vehicle.room.z_m[1] - _ROOM_MARGIN_M)


def _below_own_landing(vehicle: Vehicle) -> tuple[float, float]:
    return 0.05, max(0.05, vehicle.safety.battery_min - 0.02)


def _above_abort(vehicle: Vehicle) -> tuple[float, float]:
    return vehicle.safety.tilt_abort_deg + _FAILURE_MARGIN_DEG, 180.0


_advised = partial(Wanted, level=Level.WARN)
"""A parameter that only warns."""
_telem2 = partial(_advised, reboot=True, hardware=True)
"""The same, of the serial port."""
_RAISES = "delay of a sensor that is not fused, ms; a value above EKF2_DELAY_MAX makes PX4 raise that, so this is written first"
_FOLLOWS = "time constant with which the output follows the delayed filter, s; with a larger value, IMU errors persist for longer"
_CEILING = "0 to `room.z_m` minus 0.3"

GROUPS: dict[str, tuple[Wanted, ...]] = {
    "Estimator: motion capture, and the barometer without it": (
        Wanted("EKF2_EN", 1, "without EKF2, PX4 has no estimate at all"),
        Wanted(
            "EKF2_EV_CTRL",
            11,
            "position, height and yaw come from vision; a quantity that did not would drift",
            ok=(11, 15),
        ),
        Wanted(
            "EKF2_HGT_REF",
            3,
            "the height would follow the barometer, whose reading rotor wash shifts by a metre indoors",
            reboot=True,
        ),
        Wanted("EKF2_GPS_CTRL", 0, "a GPS fix through a window would shift the position estimate out of the room"),
        Wanted(
            "EKF2_BARO_CTRL",
            1,
            "without it, PX4 has no height 1.4 s after motion capture is lost: it descends blindly and finds the floor late or never",
        ),
        Wanted(
            "EKF2_NOAID_TOUT",
            2_000_000,
            "time without motion capture after which PX4 descends level, us; on its dead-reckoned velocity it would lean on the floor, "
            "and tip over",
            limits=(1_000_000, 2_500_000),
        ),
        Wanted(
            "EKF2_MAG_TYPE",
            5,
            "steel and motors disturb the compass; the yaw source would switch between the compass and motion capture",
            reboot=True,
        ),
        _advised("EKF2_OF_CTRL", 0, "an optical flow sensor would mistake the arm's motion for the vehicle's"),
        _advised("EKF2_RNG_CTRL", 0, "a range finder would mistake the arm or the net for the floor"),
        Wanted(
            "EKF2_EV_DELAY",
            5.0,
            "delay from exposure to arrival, ms; if it is wrong, the estimate oscillates with the vehicle's motion",
            reboot=True,
            limits=(0.0, 30.0),
            measured=True,
        ),
        _advised("EKF2_ASP_DELAY", 5.0, _RAISES, reboot=True, limits=(0.0, 50.0)),
        _advised("EKF2_GPS_DELAY", 5.0, _RAISES, reboot=True, limits=(0.0, 50.0)),
        *(_advised(f"SENS_GPS{n}_DELAY", 5, _RAISES, reboot=True, limits=(0.0, 50.0)) for n in (0, 1)),
        _advised(
            "EKF2_DELAY_MAX",
            50.0,
            "lag of the filter, ms, over which its output is predicted forward; with PX4's defaults (200 ms here, 0.25 s for "
            "EKF2_TAU_POS and EKF2_TAU_VEL), the estimate drifts by 3 to 4 mm",
            reboot=True,
            limits=(30.0, 60.0),
        ),
        *(_advised(f"EKF2_TAU_{of}", 0.1, _FOLLOWS, limits=(0.1, 0.15)) for of in ("POS", "VEL")),
        _advised(
            "EKF2_EVP_NOISE",
            0.01,
            "noise of the position, m; if it is much larger, the estimate follows the drift of the IMU instead of motion capture",
            limits=(0.005, 0.05),
        ),
        _advised(
            "EKF2_EVA_NOISE",
            0.05,
            "noise of the attitude, rad; if it is much larger, yaw lags behind motion capture",
            limits=(0.01, 0.1),
        ),
        Wanted(
            "EKF2_EV_QMIN",
            0,
            "VISION_POSITION_ESTIMATE contains no quality; if the minimum is above 0, nothing is fused",
        ),
        *(
            Wanted(
                f"EKF2_EV_POS_{axis}",
                0.0,
                "offset of the body's pivot from PX4's centre of mass, m; it shifts the estimate when the vehicle tilts",
                limits=(-0.02, 0.02),
            )
            for axis in "XYZ"
        ),
        _advised("SYS_HAS_GPS", 0, "PX4 waits for a GPS that is not used and warns that it is missing", reboot=True),
        Wanted("SYS_HAS_MAG", 0, "PX4 refuses to arm if a compass is missing or disturbed by steel", reboot=True),
        Wanted("COM_ARM_WO_GPS", 1, "if 0, PX4 refuses to arm without GPS", ok=(1, 2)),
    ),
    "Attitude control": (
        _advised(
            "MC_REF_W_N",
            200.0,
            "natural frequency of the model that attitude setpoints pass, rad/s; with PX4's 50 they lag by 40 ms, and the attitude "
            "error doubles (3.0 instead of 1.6 deg in the catch)",
            limits=(150.0, 1000.0),
        ),
        _advised(
            "MC_YAW_P",
            PX4_YAW_P,
            "rate of yaw for each rad of its error, 1/s; the yaw setpoint leads by as much as PX4 would lag behind with 2.8, so "
            "that with another value a vehicle that turns is off by a part of that",
            limits=(2.2, 3.6),
            fix="set MC_YAW_P to 2.8, PX4's default, unless yaw swings with it",
            file=False,
        ),
    ),
    "Loss of the companion": (
        Wanted(
            "COM_OF_LOSS_T",
            0.5,
            "time without a setpoint until the failsafe, s; if longer, the vehicle continues at its last attitude; if shorter, "
            "one delayed packet ends the flight",
            limits=(0.2, 0.5),
        ),
        Wanted(
            "COM_OBL_RC_ACT",
            4,
            "4 lands; 0 to 2 give control to a radio that has no pilot, 3 climbs and flies home, 6 and 7 stop the motors",
        ),
    ),
    "The pilot's radio": (
        Wanted(
            RADIO,
            NO_RADIO,
            "4 disables the pilot's sticks and mode switch; it is only for a vehicle without a radio",
            ok=(0, 1, 2, 3, 4),
            fix="without a radio set 4 (configs/px4/no_radio.params), otherwise the value for this radio",
            file=False,
        ),
        Wanted(
            "COM_KILL_DISARM",
            0.5,
            "time from the kill switch until PX4 disarms, s; a switch that is released before starts the rotors again, and PX4's "
            "own landing, which the fall has misled, may lift the vehicle",
            limits=(0.0, 1.0),
        ),
        Wanted(
            "NAV_RCL_ACT",
            3,
            "3 lands when the radio is lost; 2 climbs and flies home, which can cross the tether; 5 and 6 stop the motors",
        ),
        _advised(
            "COM_RCL_EXCEPT",
            0,
            "if bit 2 is set, PX4 ignores the loss of the radio in OFFBOARD, and the pilot cannot take over",
        ),
    ),
    "Other failsafes": (
        Wanted(
            "NAV_DLL_ACT",
            0,
            "with any other value, PX4 ends the flight when QGroundControl is closed; with 2, it climbs first",
        ),
        _advised(
            "COM_LOW_BAT_ACT",
            2,
            "2 lands at critical battery charge if the vehicle has not landed before; 3 flies home, 0 only warns",
        ),
        _advised(
            "BAT_CRIT_THR",
            0.1,
            "the companion's landing, which controls the position, must begin before PX4's own landing",
            limits=_below_own_landing,
            limits_text="0.05 to `safety.battery_min` minus 0.02",
        ),
        _advised(
            "COM_FLTT_LOW_ACT",
            1,
            "3 flies home when PX4 estimates that the flight time is used up; with 0, PX4 was observed to leave OFFBOARD for HOLD",
        ),
        Wanted("GF_ACTION", 2, "3 climbs and flies home at PX4's own geofence, 4 stops the motors", ok=(0, 1, 2, 5)),
        Wanted(
            "RTL_RETURN_ALT",
            1.5,
            "height to which PX4 climbs before it flies home, m; if too large, the ceiling or the tether stops the vehicle",
            limits=_below_ceiling,
            limits_text=_CEILING,
        ),
        _advised(
            "CBRK_FLIGHTTERM",
            121212,
            "any other value makes PX4 stop the motors in the air when it detects an attitude failure",
            reboot=True,
        ),
        *(
            _advised(
                f"FD_FAIL_{axis}",
                60,
                "tilt beyond which PX4 stops the motors in the first seconds after take-off, deg; it must be well above "
                "`safety.tilt_abort_deg`",
                limits=_above_abort,
                limits_text="at least `safety.tilt_abort_deg` + 10, at most 180",
            )
            for axis in "RP"
        ),
        _advised("CBRK_SUPPLY_CHK", 0, "any other value disables the check of the supply voltage"),
        Wanted("SYS_FAILURE_EN", 0, "if 1, one stray message could switch off a motor", reboot=True),
        Wanted("COM_THROW_EN", 0, "if 1, an armed vehicle that is picked up and moved fast would start its motors"),
    ),
    "Arming, take-off and landing": (
        Wanted(
            ROTOR_COUNT,
            None,
            "with another number, PX4 or the vehicle file describes another airframe, and thrust and torques would be wrong",
            limits=_rotors,
            limits_text="number of rotors of `airframe`",
            fix="select the machine's airframe in QGroundControl, or correct airframe.layout or airframe.rotors",
            file=False,
        ),
        Wanted(
            HOVER,
            None,
            "PX4 holds and lands with this thrust, and the companion starts from it; if it is too large, the vehicle jumps at "
            "take-off; if it is too small, the vehicle does not lift off",
            limits=_hover,
            limits_text="within 35 % of `airframe.hover_thrust`, or of weight / `airframe.thrust_max_n` if that is not set",
            fix="measure it (companion hover fit) and set it, or correct airframe.mass_kg and airframe.thrust_max_n",
            file=False,
        ),
        Wanted(
            "MC_AIRMODE", 0, "with airmode, the rotors of a standing vehicle turn at zero thrust, and it may tip over"
        ),
        _advised(
            "MC_BAT_SCALE_EN",
            0,
            "if 1, PX4 scales every thrust by the battery's voltage, while the companion corrects the same sag by its estimate of the "
            "hover thrust: the two fight",
        ),
        Wanted(
            "COM_SPOOLUP_TIME",
            1.0,
            "time after arming for which PX4 limits the thrust of its own modes, s; the companion spools up meanwhile",
            limits=(0.0, SPOOL_S),
        ),
        Wanted(
            "COM_DISARM_LAND",
            2.0,
            "time from PX4's own landing until it disarms, s; if it is 0 or less, the rotors continue to turn",
            limits=(0.1, 5.0),
        ),
        Wanted(
            "COM_DISARM_PRFLT",
            10.0,
            "time after arming within which the vehicle must take off, s; if it is too short, PX4 disarms during spool-up",
            limits=(5.0, 60.0),
        ),
        _advised(
            "MPC_LAND_SPEED",
            0.7,
            "descent speed of PX4's own landing, m/s; the net touches down first",
            limits=(0.3, 1.0),
        ),
        _advised(
            "MIS_TAKEOFF_ALT",
            1.0,
            "height to which the vehicle climbs if a pilot selects the mode Takeoff, m",
            limits=_below_ceiling,
            limits_text=_CEILING,
        ),
    ),
    "Limits of PX4's own modes: hold, return, land, position": (
        _advised(
            "MPC_TILTMAX_AIR",
            25.0,
            "tilt limit of PX4's own modes, deg; if larger, PX4 may cross the room fast after a takeover",
            limits=(20.0, 45.0),
        ),
        _advised(
            "MPC_ACC_HOR",
            8.0,
            "acceleration, m/s^2; if it is smaller, LAND sets its stop point further ahead; MPC_TILTMAX_AIR keeps the actual "
            "acceleration below it",
            limits=(5.0, 10.0),
        ),
        Wanted(
            "MPC_JERK_AUTO",
            80.0,
            "jerk, m/s^3, at which LAND of PX4 1.18 ends the acceleration that it begins with; with 6, it flies metres past its "
            "stop point",
            limits=(60.0, 80.0),
        ),
        Wanted(
            "MPC_XY_CRUISE",
            0.1,
            "speed, m/s, to which LAND brakes at once and with which it continues to its stop point; if larger, it touches down at "
            "speed and slides past it. Return flies home at this speed",
            limits=(0.05, 0.1),
        ),
        _advised(
            "MPC_XY_VEL_MAX",
            2.0,
            "horizontal speed, m/s; if larger, there is not enough distance to stop",
            limits=(0.5, 3.0),
        ),
        _advised(
            "MPC_Z_VEL_MAX_UP",
            1.0,
            "climb speed, m/s; if larger, there is not enough distance to stop below the ceiling",
            limits=(0.5, 2.0),
        ),
    ),
    "Serial link to the companion: TELEM2": (
        _telem2("MAV_1_CONFIG", 102, "with any other value, there is no MAVLink on TELEM2"),
        _telem2("MAV_1_MODE", 2, "the other modes send too few messages, and at rates that are too low"),
        _telem2(
            "MAV_1_RATE",
            80000,
            "data rate, B/s; 0 means half of the link's bandwidth, and PX4 then reduces the rate of every stream",
            limits=(60000.0, 92160.0),
        ),
        _telem2("SER_TEL2_BAUD", 921600, "a slower link cannot carry the state at full rate"),
    ),
}
"""Parameters by group, in the order in which they are documented and written."""

WANTED: tuple[Wanted, ...] = tuple(one for group in GROUPS.values() for one in group)
BY_NAME = {one.name: one for one in WANTED}


def file_values() -> dict[str, Value]:
    """Return the content of configs/px4/indoor_mocap.params."""
    return {one.name: one.value for one in WANTED if one.file and one.value is not None}


def simulated_values() -> dict[str, Value]:
    """Return the parameters of a simulated PX4 by name: those of the file, but without the serial port and for no radio."""
    return {name: value for name, value in file_values().items() if not BY_NAME[name].hardware} | {RADIO: NO_RADIO}
