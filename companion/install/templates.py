"""Contents of the files that are installed. Pure.

Sources: systemd.exec(5), systemd.service(5), systemd.kill(5), systemd.resource-control(5), sysusers.d(5), modules-load.d(5), udev(7),
limits.conf(5).
"""

from __future__ import annotations

STOP_TIMEOUT_S = 180
"""For a landing: the retreat along the tether, PX4's landing and its confirmation take a minute at most; then as long again twice."""
RTPRIO = 60
"""Of the guardian; the flight asks for less."""
STATE = "companion/fly"
"""Below /var/lib. The folder above it holds the record that `--undo` trusts, so that one belongs to root."""
_GOVERNORS = "/sys/devices/system/cpu/cpufreq/policy*/scaling_governor"
_HEAD = "# Written by companion install; companion install --undo takes it away."


def exec_word(text: str) -> str:
    """One word of a systemd command line: its quotes, specifiers and variables escaped."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if any(c in text for c in " \t\"'\\;") else escaped


def service(user: str, program: str, mission: str, vehicle: str | None) -> str:
    """companion.service."""
    words = [program, "fly", mission, *(("--vehicle", vehicle) if vehicle is not None else ()), "--wait-for-start"]
    return f"""{_HEAD}
[Unit]
Description=companion: waits on the ground until a signed operator commands start
Wants=network-online.target
After=network-online.target mosquitto.service companion-performance.service

[Service]
Type=exec
ExecStart={" ".join(map(exec_word, [*words, "--no-report"]))}
User={user}
SupplementaryGroups=dialout
StateDirectory={STATE}
StateDirectoryMode=0750
WorkingDirectory=/var/lib/{STATE}
Environment=HOME=/var/lib/{STATE} PYTHONUNBUFFERED=1

# A flight that ended is never begun again by a machine: a person looks first.
Restart=no
# SIGTERM goes to the launcher alone, which lands; to all at once it would end the guardian and cut the log. And when the launcher
# itself is gone, nobody kills the flight that still lands, or its guardian.
KillMode=process
KillSignal=SIGTERM
TimeoutStopSec={STOP_TIMEOUT_S}
# 4: given up and landed, or never lifted; what systemctl stop asks for.
SuccessExitStatus=4
OOMPolicy=continue
OOMScoreAdjust=-900

# The processes ask for SCHED_FIFO and locked memory themselves, thread by thread; here is the permission.
LimitRTPRIO={RTPRIO}
LimitMEMLOCK=infinity
Nice=-5

# Serial ports and pseudo-terminals; nothing else of /dev. No filter of system calls: it would kill in the air.
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
    """companion-performance.service: every core at full clock; stopped, it puts back what was.

    Args:
        governors, memory: for tests; where the governors are told, and where to remember what they were.
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
    """Rules for the two USB serial adapters, both with FTDI's chips."""
    lines = [
        _HEAD,
        "# An answer waits in the adapter for this long; the driver's default of 16 ms costs three ticks per cycle of the arm's bus.",
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"',
    ]
    for name, what, serial in (
        ("companion-arm", "the arm's U2D2", arm_serial),
        ("companion-force", "the force sensor's adapter", force_serial),
    ):
        if serial is None:
            lines.append(f"# No name for {what}: it was not plugged in, and no serial number was given.")
        else:
            lines.append(
                f'ACTION!="remove", SUBSYSTEM=="tty", ATTRS{{idVendor}}=="0403", ATTRS{{serial}}=="{serial}", '
                f'SYMLINK+="{name}", GROUP="dialout", MODE="0660"'
            )
    return "\n".join(lines) + "\n"


def limits() -> str:
    """For people of the group dialout who fly from a shell; a service has its own limits."""
    return f"{_HEAD}\n@dialout - rtprio {RTPRIO}\n@dialout - memlock unlimited\n"


def modules() -> str:
    """Loaded at boot: a service's DeviceAllow knows only drivers that are there when it starts."""
    return f"{_HEAD}\nftdi_sio\ncdc_acm\n"


def sysusers(user: str) -> str:
    """The service's user, without a login, and its group for serial ports."""
    return f'{_HEAD}\nu {user} - "companion flight service" /var/lib/{STATE}\nm {user} dialout\n'
