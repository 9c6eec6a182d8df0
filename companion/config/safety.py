"""The safety settings of the vehicle file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import Fraction, Model, NonNegative, PerJoint, Positive


class Safety(Model):
    """Thresholds of the safety rules, and limits of the reactions. docs/internals/safety.md describes the rules."""

    preflight_s: Annotated[float, Field(ge=1, le=60)] = 5.0
    """Time for which the preflight check observes all devices before arming."""

    # Motion capture
    mocap_timeout_s: Positive = 0.2
    """Max age of a motion-capture pose; beyond it, the arm folds and PX4 lands using its own estimate. Until then, the vehicle
    follows PX4's dead reckoning: with an acceleration error of 0.5 m/s^2, it is off by 10 mm after 0.2 s and by 31 mm after 0.35 s.
    After 0.55 s,
    PX4's fusion flags are cleared. In a simulated laboratory without faults, hidden markers interrupt tracking for up to 0.1 s."""
    mocap_rate_min_hz: Positive = 50.0
    """Rate of poses below which a warning is raised."""
    mocap_latency_warn_s: Positive = 0.05
    """Time from the mid-exposure of a pose to its arrival, the network included, above which a warning is raised."""
    mocap_latency_max_s: Positive = 0.12
    """Latency above which a pose is not passed on and PX4 lands. PX4 fuses a pose at its arrival time minus EKF2_EV_DELAY, so at 1 m/s
    a pose that is 0.12 s late is off by 0.11 m, about as much as `mocap_jump_m` allows."""
    mocap_jump_m: Positive = 0.10
    """Largest distance between a pose and the position predicted from PX4's velocity; a more distant pose is ignored."""
    mocap_jump_deg: Positive = 20.0
    """Largest change of a pose's attitude in excess of the change computed from the angular rates."""
    mocap_frozen_s: Positive = 0.10
    """Longest time with new frames but an identical pose while the vehicle is moving."""
    mocap_inertial_m: Positive = 0.04
    """Largest distance between a pose and the position predicted from the IMU; above it, PX4 lands without motion capture. If one IMU
    sample in ten is lost, the distance reaches 0.024 at a vibration of 10 m/s^2 and 0.036 at 15 m/s^2. A limit of 0.015 detects poses
    that drift away at 0.2 m/s or faster, 0.025 at 0.3 m/s and 0.04 at 0.5 m/s; a vehicle that vibrates less should use a smaller
    value.
    """
    mocap_inertial_s: NonNegative = 0.05
    """Hold time of `mocap_inertial_m`."""
    estimate_disagreement_m: Positive = 0.30
    """Largest distance between PX4's position estimate and the motion-capture position."""
    yaw_disagreement_deg: Positive = 15.0
    """Largest difference between PX4's yaw and the motion-capture yaw."""

    # PX4 and battery
    vehicle_timeout_s: Positive = 0.25
    """Max age of PX4's attitude and position estimates."""
    link_lag_warn_s: Positive = 0.02
    """Delay of PX4's messages relative to their smallest delay above which a warning is raised."""
    link_lag_max_s: Positive = 0.035
    """Largest such delay; above it, PX4 lands. With the same delay in both directions, the position error of the law `adaptive` exceeds
    0.1 m from 0.045 s on, that of `psc` and `csc` in some simulated laboratories from 0.04 s on; at 0.03 s none swings."""
    heartbeat_timeout_s: Positive = 2.5
    battery_min: Fraction = 0.2
    battery_warn: Fraction = 0.3
    battery_voltage_min_v: Positive | None = 13.2
    """Lowest permitted voltage under load; the default is 3.3 V per cell of a 4S battery. null disables the rule."""

    # Arm and force sensor
    arm_timeout_s: Positive = 0.10
    """Max age of the joint state; beyond it, the vehicle lands."""
    arm_read_failures_max: Annotated[int, Field(ge=1)] = 5
    """Largest number of consecutive bus cycles without an answer."""
    servo_warn_c: Positive = 65.0
    servo_max_c: Positive = 75.0
    """Temperature above which the vehicle lands; it must be below the temperature at which a servo shuts down (80 degC; 70 degC for the
    330 models)."""
    servo_overload_s: Positive = 1.0
    """Longest time for which a joint may be at its torque limit."""
    joint_jump_deg: Positive = 15.0
    """Largest change of a joint angle between two reads in excess of the change at the joint's largest speed."""
    joint_rate_max_deg_s: Positive = 700.0
    """Largest plausible joint rate; no XM430-W210 reaches it, even when driven by an external force."""
    joint_limit_warn_deg: Positive = 3.0
    joint_limit_max_deg: Positive = 10.0
    """Largest angle by which a joint may exceed its limits; beyond it, the vehicle lands."""
    servo_current_max_a: Positive | None = None
    """Largest commanded current of each servo; null for the stall current of its model."""
    force_timeout_s: Positive = 0.25
    """Max age of a force sample; beyond it, the controller continues without the force and a warning is raised."""
    force_stuck_s: Positive = 0.5
    """Time with new but identical samples after which the controller continues without the force. In 200 simulated laboratories a
    healthy sensor with a resolution of 0.2 N repeated itself for 0.27 s at most.
    """
    force_drift_n: Positive = 2.0
    """Largest lasting force on the net before the catch. In simulated laboratories without faults, drift and the rotors' wake on the
    net reached 1.5 N.
    """
    force_disagreement_n: Positive = 1.0
    """Largest change of the measured force that the vehicle's motion does not show. Beyond it, the controller flies without the
    force. In 200 simulated laboratories without faults it reached 0.9 for less than 0.3 s.
    """

    # The flight itself
    loop_late_s: Positive = 0.05
    """Delay of a control tick above which a warning is raised."""
    loop_stalled_s: Positive = 0.3
    """Delay of a control tick above which the vehicle lands."""
    command_state_age_max_s: Positive = 0.10
    """Max age of the attitude from which a setpoint is computed; a setpoint computed from an older attitude is not sent to PX4."""
    thrust_slew_max_per_s: Positive = 100.0
    """Largest rate of change of the normalised thrust, far above the rate during a catch."""
    tilt_abort_deg: Annotated[float, Field(gt=0, le=80)] = 40.0
    tracking_error_warn_m: Positive = 0.45
    tracking_error_hold_m: Positive = 0.6
    tracking_error_abort_m: Positive = 0.8
    oscillation_m: Positive = 0.10
    """Horizontal distance between two turning points of the position error from which a swing counts; four of them within 6 s are an
    oscillation, and PX4 lands."""
    thrust_saturated_s: Positive = 1.0
    """Largest difference between the time at the upper thrust limit and the time below it."""
    speed_max_m_s: Positive = 2.0
    """Largest horizontal speed; a mission's speed limit must be lower."""
    contact_force_max_n: Positive = 12.0
    """Largest force against the direction of an approach; above it, the vehicle moves back from the surface and holds."""
    contact_disagreement_n: Positive = 4.0
    """Largest force against the direction of an approach that the vehicle's motion shows in excess of the measured one, and
    largest push against nothing. With a healthy sensor, gusts in simulated laboratories reached 3.1 N."""
    climb_max_m_s: Positive = 1.5
    sink_max_m_s: Positive = 1.5
    geofence_tolerance_m: NonNegative = 0.10
    """Distance by which the rotors may leave the room, because a mission may use the whole room and tracking is not exact."""
    tether_stop_slack_min_m: NonNegative = 0.10
    """Smallest tether slack at the position where the vehicle is predicted to stop."""

    # Reactions
    react_time_s: NonNegative = 0.21
    """Time from a fault to PX4's LAND mode. With the guardian and PX4 1.16.1, 0.07 to 0.21 s were measured."""
    stop_deceleration_m_s2: Positive = 2.0
    """Deceleration with which the governor stops the reference. Stopping distances assume the slower of this stop and a stop in PX4's
    LAND mode from the same speed."""
    guardian_timeout_s: Positive = 0.1
    """Time without a heartbeat from the flight process, while the rotors turn, after which the guardian kills that process, takes over
    and lands. In such a takeover this time is part of `react_time_s`, which must be increased with it.
    """
    hold_max_s: Positive = 20.0
    """Longest duration of a HOLD, after which the vehicle lands."""
    retract_max_s: Positive = 12.0
    """Longest duration of a RETRACT, after which the vehicle lands where it is."""
    retract_speed_m_s: Positive = 0.3
    retract_slack_m: Positive = 0.6
    """Tether slack at the end of a RETRACT."""
    land_speed_m_s: Positive = 0.35
    fold_arm_deg: PerJoint = (165.0, 140.0)
    """Joint angles of the folded arm, the pose `folded` of missions. The default is for an arm of two joints."""

    # A bar that two vehicles carry
    partner_timeout_s: Positive = 0.3
    """Longest silence of the other vehicle, which announces its state 50 times a second."""
    bar_force_max_n: Positive = 10.0
    """Force of the bar on the clamp above which both vehicles land."""
    bar_let_go_n: Positive = 18.0
    """Force of the bar on the clamp above which it is let go at once, whatever the height: the other vehicle falls or pulls away."""
