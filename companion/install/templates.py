"""Contents of the installed files. Pure functions.

Sources: systemd.exec(5), systemd.service(5), systemd.kill(5), systemd.resource-control(5), sysusers.d(5), modules-load.d(5),
udev(7), limits.conf(5).
"""

from __future__ import annotations

STOP_TIMEOUT_S = 180
"""Time allowed for a landing: three times the minute that the return along the tether, PX4's landing and its confirmation take at
most.
"""
RTPRIO = 60
"""Limit of the real-time priority: the guardian's priority; the flight process uses a lower one."""
STATE_DIRECTORY = "companion/fly"
"""Folder below /var/lib. Its parent holds the record that `--undo` trusts and therefore belongs to root."""
_GOVERNORS = "/sys/devices/system/cpu/cpufreq/policy*/scaling_governor"
_HEAD = "# Written by companion install; companion install --undo removes it."


def exec_word(text: str) -> str:
    """Return one word of a systemd command line with quotes, specifiers and variables escaped."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if any(c in text for c in " \t\"'\\;") else escaped


def service(user: str, program: str, mission: str, vehicle: str | None) -> str:
    """Return the content of companion.service."""
    words = [program, "fly", mission, *(("--vehicle", vehicle) if vehicle is not None else ()), "--wait-for-start"]
    return f"""{_HEAD}
[Unit]
Description=companion: waits on the ground for an operator's signed start command
Wants=network-online.target
After=network-online.target mosquitto.service companion-performance.service

[Service]
Type=exec
ExecStart={" ".join(map(exec_word, [*words, "--no-report"]))}
User={user}
SupplementaryGroups=dialout
StateDirectory={STATE_DIRECTORY}
StateDirectoryMode=0750
WorkingDirectory=/var/lib/{STATE_DIRECTORY}
Environment=HOME=/var/lib/{STATE_DIRECTORY} PYTHONUNBUFFERED=1

# A flight that ended is never restarted automatically: an operator checks the vehicle first.
Restart=no
# SIGTERM goes to the launcher only, which lands; sent to all it would end the guardian and truncate the log. If the launcher
# itself is gone, the landing flight process and its guardian are not killed.
KillMode=process
KillSignal=SIGTERM
TimeoutStopSec={STOP_TIMEOUT_S}
# 4: aborted and landed, or never took off; also the result of systemctl stop.
SuccessExitStatus=4
OOMPolicy=continue
OOMScoreAdjust=-900

# The processes request SCHED_FIFO and locked memory themselves, per thread; this permits it.
LimitRTPRIO={RTPRIO}
LimitMEMLOCK=infinity
Nice=-5

# Serial ports and pseudo-terminals, nothing else in /dev. No system call filter: it would kill the process in the air.
DevicePolicy=closed
DeviceAllow=char-ttyUSB rw
DeviceAllow=char-ttyACM rw
DeviceAllow=char-ttyAMA rw
DeviceAllow=char-ttyS rw
CapabilityBoundingSet=
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectHostname=yes
RestrictSUIDSGID=yes
RestrictNamespaces=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
LockPersonality=yes
UMask=0027

[Install]
WantedBy=multi-user.target
"""


def performance_service(governors: str = _GOVERNORS, memory: str = "/run/companion-performance/before") -> str:
    """Return the content of companion-performance.service, which runs every core at full clock and restores the previous
    governors when stopped.

    Args:
        governors, memory: paths of the governor files, and of the file that keeps their previous values; for tests.
    """
    start = (
        f'for g in {governors}; do echo "$$(cat $$g) $$g"; done > {memory} && '
        f"for g in {governors}; do echo performance > $$g; done"
    )
    stop = f"while read was g; do echo $$was > $$g; done < {memory}"
    return f"""{_HEAD}
[Unit]
Description=companion: every processor core at full clock
ConditionPathExistsGlob={governors}
After=raspi-config.service cpufrequtils.service

[Service]
Type=oneshot
RemainAfterExit=yes
RuntimeDirectory=companion-performance
ExecStart=/bin/sh -c '{start}'
ExecStop=/bin/sh -c '{stop}'

[Install]
WantedBy=multi-user.target
"""


def udev_rules(arm_serial: str | None, force_serial: str | None) -> str:
    """Return the rules for the two USB serial adapters, both with FTDI chips."""
    lines = [
        _HEAD,
        "# The adapter delays an answer by this time; the driver's default of 16 ms costs three ticks per cycle of the arm's bus.",
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"',
    ]
    for name, what, serial in (
        ("companion-arm", "the arm's U2D2", arm_serial),
        ("companion-force", "the force sensor's adapter", force_serial),
    ):
        if serial is None:
            lines.append(f"# No stable name for {what}: it was not plugged in, and no serial number was given.")
        else:
            lines.append(
                f'ACTION!="remove", SUBSYSTEM=="tty", ATTRS{{idVendor}}=="0403", ATTRS{{serial}}=="{serial}", '
                f'SYMLINK+="{name}", GROUP="dialout", MODE="0660"'
            )
    return "\n".join(lines) + "\n"


def limits() -> str:
    """Return the limits file: real-time priority and locked memory for members of dialout in a shell; a service has its own."""
    return f"{_HEAD}\n@dialout - rtprio {RTPRIO}\n@dialout - memlock unlimited\n"


def modules() -> str:
    """Return the modules-load.d file with the drivers to load at boot: a service's DeviceAllow covers only loaded drivers."""
    return f"{_HEAD}\nftdi_sio\ncdc_acm\n"


def sysusers(user: str) -> str:
    """Return the sysusers.d file that creates the service's user, without a login, in the group of the serial ports."""
    return f'{_HEAD}\nu {user} - "companion flight service" /var/lib/{STATE_DIRECTORY}\nm {user} dialout\n'
