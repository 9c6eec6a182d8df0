"""Drivers of the vehicle's devices, one package each. Units and frames are converted here and nowhere else.

Each package has a driver with threads and timeouts, and codecs without I/O: `mocap.natnet` (packets and axes of motion capture),
`dynamixel.registers` (control table of the servos), `force_torque.rft` (packets of the sensor), `px4.messages` and `px4.inbox`
(messages of PX4). To add a device, implement a Protocol of `protocols` and open the device in `devices`. Addresses and baud rates
are in `companion.config.vehicle`.
"""
