"""Install and undo: files below a root, commands only where that root is this computer's own.

Every change is in the record before it is made. So an installation that fails puts everything back at once, and `undo` puts back one
that was cut off (power).
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import shutil
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from companion.install.plan import PERFORMANCE, SERVICE, Command, Plan
from companion.install.record import PATH, Entry, Record, inside, load, save
from companion.install.state import InstallError, State, put, read
from companion.install.templates import STATE

GROUP = "dialout"
COMMAND_TIMEOUT_S = 60.0
HOME = f"/var/lib/{STATE}"
"""Of the service's user: flight logs, and in .config the operators' keys that the vehicle has made."""
_TOOLS = "/usr/sbin:/sbin:/usr/bin:/bin"

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Changes:
    """What an installation would do, or did."""

    entries: Mapping[str, Entry]
    """All of the record's, by path."""
    now: Mapping[str, State]
    """What stands there at the moment."""
    folders: tuple[str, ...]
    """That are to be made, outermost first."""

    @property
    def to_do(self) -> tuple[str, ...]:
        """Paths that are not yet as they are to be."""
        return tuple(path for path, entry in self.entries.items() if not self.now[path].same(entry.after))


def changes(root: Path, plan: Plan, record: Record | None) -> Changes:
    """Look; nothing is changed.

    Raises:
        InstallError: a file is in the way, or somebody has changed one since it was installed.
    """
    old = record or Record()
    entries, now = {}, {}
    for item in plan.items:
        state = State(
            content=None if item.content is None else item.content.encode(),
            link=item.link,
            mode=item.mode if item.link is None else 0,
        )
        found = now[item.path] = read(inside(root, item.path))
        entries[item.path] = Entry(before=_before(item.path, found, old), after=state)
    for path, entry in old.entries.items():
        if path not in entries:  # an earlier installation wanted it
            found = now[path] = read(inside(root, path))
            entries[path] = Entry(before=_before(path, found, old), after=entry.before)
    folders: list[str] = []
    for path in (*entries, PATH):
        missing = [
            folder
            for folder in Path(path).parents
            if not inside(root, str(folder)).is_dir() and str(folder) not in folders
        ]
        folders += [str(folder) for folder in reversed(missing)]
    return Changes(entries, now, tuple(folders))


def _before(path: str, found: State, old: Record) -> State:
    entry = old.entries.get(path)
    if entry is None:
        return found
    if not found.same(entry.after) and not found.same(entry.before):
        raise InstallError(changed_by_others(path))
    return entry.before


def changed_by_others(path: str) -> str:
    """One line."""
    return f"{path}: was changed since companion install wrote it; put that back, or move the file away, then try again"


def install(root: Path, plan: Plan, user: str, tell: Tell) -> bool:
    """Make everything as planned; False: there was nothing to do.

    Raises:
        InstallError: it could not be done; everything is as it was before.
    """
    record = load(root)
    found = changes(root, plan, record)
    live = root == Path("/")
    old = record or Record()
    if record is not None and record.complete and not found.to_do and not (live and _missing(user)):
        return False
    made = Record(
        entries=found.entries,
        folders=(*old.folders, *found.folders),
        users=(*old.users, *([user] if live and not _exists(user) else [])),
        joined=(*old.joined, *([user] if live and _exists(user) and not _in_group(user) else [])),
    )
    try:
        for folder in found.folders:
            inside(root, folder).mkdir(mode=0o755)
        save(root, made)
        for path in found.to_do:
            put(inside(root, path), found.entries[path].after)
            tell(f"{'took away' if found.entries[path].after.absent else 'wrote'} {path}")
        if live:
            for command in plan.commands:
                _run(command, tell)
        kept = {path: entry for path, entry in found.entries.items() if not entry.before.same(entry.after)}
        save(root, replace(made, entries=kept, complete=True))
    except (OSError, InstallError, KeyboardInterrupt) as error:
        trouble = _put_back(
            root,
            found,
            record,
            replace(made, users=made.users[len(old.users) :], joined=made.joined[len(old.joined) :]),
        )
        if isinstance(error, KeyboardInterrupt):
            raise
        why = error if isinstance(error, InstallError) else f"{error.filename}: {error.strerror}"
        if trouble:
            raise InstallError(f"{why}; could not be put back: {trouble}; then: companion install --undo") from None
        raise InstallError(f"{why}; everything is as it was before") from None
    return True


def _put_back(root: Path, found: Changes, record: Record | None, made: Record) -> str:
    """As it was before this installation, which made these users; returns what could not be put back."""
    trouble = []
    for path in reversed(found.to_do):
        try:
            put(inside(root, path), found.now[path])
        except OSError as error:
            if not inside(root, path).parent.is_dir() and found.now[path].absent:
                continue  # its folder could not be made
            trouble.append(f"{path}: {error.strerror}")
    if trouble:
        return "; ".join(trouble)  # the record stays, for undo
    _remove_users(made, lambda _: None)
    with contextlib.suppress(OSError):
        if record is None:
            inside(root, PATH).unlink(missing_ok=True)
        else:
            save(root, record)
    _remove_folders(root, found.folders)
    return ""


def undo(root: Path, tell: Tell) -> bool:
    """Take everything back; False: nothing is installed.

    Raises:
        InstallError: somebody changed a file since, or the service runs: nothing was touched. Or: it stopped half way; doing it again
            goes on from there.
    """
    record = load(root)
    if record is None:
        return False
    live = root == Path("/")
    back = []
    for path, entry in record.entries.items():
        now = read(inside(root, path))
        if not now.same(entry.before):
            if not now.same(entry.after):
                raise InstallError(changed_by_others(path))
            back.append(path)
    if live:
        if _active(SERVICE):
            raise InstallError(f"{SERVICE} runs; systemctl stop companion first (in the air it lands)")
        if PERFORMANCE in " ".join(back):
            _run(Command(("systemctl", "stop", PERFORMANCE), "puts the clock back"), tell)
    try:
        for path in reversed(back):
            put(inside(root, path), record.entries[path].before)
            tell(f"{'took away' if record.entries[path].before.absent else 'put back'} {path}")
        _disown(root, record, tell)
        if live:
            _remove_users(record, tell)
            for words in (("udevadm", "control", "--reload"), ("systemctl", "daemon-reload")):
                _run(Command(words, ""), tell)
        inside(root, PATH).unlink()
    except OSError as error:
        raise InstallError(f"{error.filename}: {error.strerror}; mend that, then: companion install --undo") from None
    for folder in _remove_folders(root, record.folders):
        tell(f"kept {folder}: something else is in it")
    return True


def _disown(root: Path, record: Record, tell: Tell) -> None:
    """Leave nothing to the id of a user who is deleted: the system may give that id to somebody else.

    The service's keys are deleted, its logs belong to whoever undoes the installation (root) from now on. A home that belongs to a
    user who stays is not touched.

    Raises:
        OSError: a file cannot be deleted or given to another owner.
    """
    home = inside(root, HOME)
    if not record.users or home.is_symlink() or not home.is_dir():
        return
    if _name_of(home.stat().st_uid) not in (None, *record.users):
        return
    config = home / ".config"
    if config.is_symlink():
        config.unlink()
    elif config.exists():
        shutil.rmtree(config)
        tell(f"took away {HOME}/.config: the service's keys")
    owner, group = os.geteuid(), os.getegid()
    for _, folders, files, folder_fd in os.fwalk(
        home
    ):  # follows no symbolic link: what is in there was written by the service
        os.fchown(folder_fd, owner, group)
        for name in (*folders, *files):
            os.chown(name, owner, group, dir_fd=folder_fd, follow_symlinks=False)


def _name_of(user_id: int) -> str | None:
    try:
        return pwd.getpwuid(user_id).pw_name
    except KeyError:
        return None


def _remove_users(record: Record, tell: Tell) -> None:
    for user in record.users:
        if _exists(user):
            _run(Command(("userdel", user), "takes the user away"), tell)
    for user in record.joined:
        if _exists(user) and _in_group(user):
            _run(Command(("gpasswd", "-d", user, GROUP), "out of the group"), tell)


def _remove_folders(root: Path, folders: tuple[str, ...]) -> list[str]:
    """Innermost first; returns those that are not empty."""
    kept = []
    for folder in reversed(folders):
        try:
            inside(root, folder).rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            kept.append(folder)
    return kept


def _missing(user: str) -> bool:
    return not _exists(user) or not _in_group(user)


def _exists(user: str) -> bool:
    try:
        pwd.getpwnam(user)
    except KeyError:
        return False
    return True


def _in_group(user: str) -> bool:
    try:
        group = grp.getgrnam(GROUP)
    except KeyError:
        return False
    return user in group.gr_mem or pwd.getpwnam(user).pw_gid == group.gr_gid


def _active(unit: str) -> bool:
    tool = shutil.which("systemctl", path=_TOOLS)
    if tool is None:
        return False
    ended = subprocess.run(
        [tool, "is-active", unit],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        timeout=COMMAND_TIMEOUT_S,
        check=False,
    )
    return ended.stdout.strip() in ("active", "activating", "deactivating", "reloading")


def _run(command: Command, tell: Tell) -> None:
    """Run one.

    Raises:
        InstallError: it failed, and it is needed.
    """
    tool = shutil.which(command.words[0], path=_TOOLS)
    why = ""
    if tool is None:
        why = "no such program"
    else:
        try:
            ended = subprocess.run(
                [tool, *command.words[1:]],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                timeout=COMMAND_TIMEOUT_S,
                env={**os.environ, "LC_ALL": "C", "PATH": _TOOLS},
                check=False,
            )
            if ended.returncode != 0:
                why = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1]
        except (OSError, subprocess.TimeoutExpired) as error:
            why = str(error)
    if not why:
        tell(f"ran {command}")
    elif command.needed:
        raise InstallError(f"{command}: {why}")
    else:
        tell(f"did not work, the next boot does it: {command}: {why}")
