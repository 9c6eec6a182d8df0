"""Drivers of the vehicle's devices, one package each. Units and frames are converted here and nowhere else.

Each package has a driver with threads and timeouts, and codecs without I/O: `mocap.natnet` (packets and axes of motion capture),
`dynamixel.registers` (control table of the servos), `force_torque.rft` (packets of the sensor), `px4.messages` and `px4.inbox`
(messages of PX4). `mocap`, `force_torque` and `arm` also have the contracts of plug-ins (`mocap.system`, `force_torque.sensor`,
`arm.motors`) and the drivers that run them; `mocap.optitrack` is such a plug-in. Addresses and baud rates are in
`companion.config.devices`.
"""
