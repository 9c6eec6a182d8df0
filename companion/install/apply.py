"""Installation and undo. Files are changed below a root folder; commands run only if that folder is the root of the running
system.

Every change is recorded before it is made. A failed installation is rolled back at once, and `undo` also reverts one that was
interrupted by a power loss.
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
from companion.install.record import RECORD_PATH, Entry, Record, load, save, under_root
from companion.install.state import InstallError, PathState, read_state, write_state
from companion.install.templates import STATE_DIRECTORY
from companion.runtime.subprocesses import captured

GROUP = "dialout"
COMMAND_TIMEOUT_S = 60.0
HOME = f"/var/lib/{STATE_DIRECTORY}"
"""Home of the service's user. It holds flight logs and, in .config, the operator keys that the vehicle created."""
_TOOLS = "/usr/sbin:/sbin:/usr/bin:/bin"

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Changes:
    """Changes that an installation makes."""

    entries: Mapping[str, Entry]
    now: Mapping[str, PathState]
    folders: tuple[str, ...]
    """Folders to create, outermost first."""

    @property
    def to_do(self) -> tuple[str, ...]:
        """Paths whose content differs from the plan."""
        return tuple(path for path, entry in self.entries.items() if not self.now[path].matches(entry.after))


def pending_changes(root: Path, plan: Plan, record: Record | None) -> Changes:
    """Return the changes that the plan requires in the file system, without making any.

    Raises:
        InstallError: a path holds something other than a file or link, or a file has been modified since it was installed.
    """
    old = record or Record()
    entries, now = {}, {}
    for item in plan.items:
        state = PathState(
            content=None if item.content is None else item.content.encode(),
            link=item.link,
            mode=item.mode if item.link is None else 0,
        )
        found = now[item.path] = read_state(under_root(root, item.path))
        entries[item.path] = Entry(before=_before(item.path, found, old), after=state)
    for path, entry in old.entries.items():
        if path not in entries:  # only an earlier installation needed it
            found = now[path] = read_state(under_root(root, path))
            entries[path] = Entry(before=_before(path, found, old), after=entry.before)
    folders: list[str] = []
    for path in (*entries, RECORD_PATH):
        missing = [
            folder
            for folder in Path(path).parents
            if not under_root(root, str(folder)).is_dir() and str(folder) not in folders
        ]
        folders += [str(folder) for folder in reversed(missing)]
    return Changes(entries, now, tuple(folders))


def _before(path: str, found: PathState, old: Record) -> PathState:
    entry = old.entries.get(path)
    if entry is None:
        return found
    if not found.matches(entry.after) and not found.matches(entry.before):
        raise InstallError(changed_by_others(path))
    return entry.before


def changed_by_others(path: str) -> str:
    """Return the error message for a file that was modified after the installation."""
    return f"{path}: was modified after it was installed; restore it or move it away, then try again"


def install(root: Path, plan: Plan, user: str, report: Report) -> bool:
    """Carry out the plan; return False if there was nothing to do.

    Raises:
        InstallError: the installation failed and was rolled back.
    """
    record = load(root)
    found = pending_changes(root, plan, record)
    live = root == Path("/")
    old = record or Record()
    if (
        record is not None
        and record.complete
        and not found.to_do
        and not (live and not (_user_exists(user) and _user_in_group(user)))
    ):
        return False
    made = Record(
        entries=found.entries,
        folders=(*old.folders, *found.folders),
        users=(*old.users, *([user] if live and not _user_exists(user) else [])),
        joined=(*old.joined, *([user] if live and _user_exists(user) and not _user_in_group(user) else [])),
    )
    try:
        for folder in found.folders:
            under_root(root, folder).mkdir(mode=0o755)
        save(root, made)
        for path in found.to_do:
            write_state(under_root(root, path), found.entries[path].after)
            report(f"{'removed' if found.entries[path].after.absent else 'wrote'} {path}")
        if live:
            for command in plan.commands:
                _run(command, report)
        kept = {path: entry for path, entry in found.entries.items() if not entry.before.matches(entry.after)}
        save(root, replace(made, entries=kept, complete=True))
    except (OSError, InstallError, KeyboardInterrupt) as error:
        trouble = _roll_back(
            root,
            found,
            record,
            replace(made, users=made.users[len(old.users) :], joined=made.joined[len(old.joined) :]),
        )
        if isinstance(error, KeyboardInterrupt):
            raise
        why = error if isinstance(error, InstallError) else f"{error.filename or 'standard output'}: {error.strerror}"
        if trouble:
            raise InstallError(
                f"{why}; not restored: {trouble}; fix that, then run: companion install --undo"
            ) from None
        raise InstallError(f"{why}; all changes were reverted") from None
    return True


def _roll_back(root: Path, found: Changes, record: Record | None, made: Record) -> str:
    """Restore the state from before this installation, remove the users `made` by it, and return what could not be restored."""
    trouble = []
    for path in reversed(found.to_do):
        try:
            write_state(under_root(root, path), found.now[path])
        except OSError as error:
            if not under_root(root, path).parent.is_dir() and found.now[path].absent:
                continue  # its folder could not be created
            trouble.append(f"{path}: {error.strerror}")
    if trouble:
        return "; ".join(trouble)  # the record remains for undo
    _remove_users(made, lambda _: None)
    with contextlib.suppress(OSError):
        if record is None:
            under_root(root, RECORD_PATH).unlink(missing_ok=True)
        else:
            save(root, record)
    _remove_folders(root, found.folders)
    return ""


def undo(root: Path, report: Report) -> bool:
    """Revert the installation; return False if nothing is installed.

    Raises:
        InstallError: nothing was reverted, because a file was modified after the installation or the service is running; or the
            undo failed part-way and can be run again.
    """
    record = load(root)
    if record is None:
        return False
    live = root == Path("/")
    back = []
    for path, entry in record.entries.items():
        now = read_state(under_root(root, path))
        if not now.matches(entry.before):
            if not now.matches(entry.after):
                raise InstallError(changed_by_others(path))
            back.append(path)
    if live:
        if _service_active():
            raise InstallError(
                f"{SERVICE} is running; first run: systemctl stop companion (a flying vehicle lands first)"
            )
        if PERFORMANCE in " ".join(back):
            _run(Command(("systemctl", "stop", PERFORMANCE), "restores the CPU clock"), report)
    try:
        for path in reversed(back):
            write_state(under_root(root, path), record.entries[path].before)
            report(f"{'removed' if record.entries[path].before.absent else 'restored'} {path}")
        _take_ownership(root, record, report)
        if live:
            _remove_users(record, report)
            for argv in (("udevadm", "control", "--reload"), ("systemctl", "daemon-reload")):
                _run(Command(argv, ""), report)
        under_root(root, RECORD_PATH).unlink()
    except OSError as error:
        raise InstallError(
            f"{error.filename or 'standard output'}: {error.strerror}; fix that, then run: companion install --undo"
        ) from None
    for folder in _remove_folders(root, record.folders):
        report(f"kept {folder}: it is not empty")
    return True


def _take_ownership(root: Path, record: Record, report: Report) -> None:
    """Delete or reassign the files of deleted users: the system may assign a deleted user's id to another user.

    The service's keys are deleted; its logs go to the user who runs the undo (root). The home of a user who is not deleted is not
    touched.

    Raises:
        OSError: a file cannot be deleted or its owner cannot be changed.
    """
    home = under_root(root, HOME)
    if not record.users or home.is_symlink() or not home.is_dir():
        return
    if _user_name(home.stat().st_uid) not in (None, *record.users):
        return
    config = home / ".config"
    if config.is_symlink():
        config.unlink()
    elif config.exists():
        shutil.rmtree(config)
        report(f"removed {HOME}/.config: the service's keys")
    owner, group = os.geteuid(), os.getegid()
    # fwalk follows no symbolic link, because the service wrote the contents.
    for _, folders, files, folder_fd in os.fwalk(home):
        os.fchown(folder_fd, owner, group)
        for name in (*folders, *files):
            os.chown(name, owner, group, dir_fd=folder_fd, follow_symlinks=False)


def _user_name(user_id: int) -> str | None:
    try:
        return pwd.getpwuid(user_id).pw_name
    except KeyError:
        return None


def _remove_users(record: Record, report: Report) -> None:
    for user in record.users:
        if _user_exists(user):
            _run(Command(("userdel", user), "removes the user"), report)
    for user in record.joined:
        if _user_exists(user) and _user_in_group(user):
            _run(Command(("gpasswd", "-d", user, GROUP), "removes the user from the group"), report)


def _remove_folders(root: Path, folders: tuple[str, ...]) -> list[str]:
    """Remove empty folders, innermost first; return those that are not empty."""
    kept = []
    for folder in reversed(folders):
        try:
            under_root(root, folder).rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            kept.append(folder)
    return kept


def _user_exists(user: str) -> bool:
    try:
        pwd.getpwnam(user)
    except KeyError:
        return False
    return True


def _user_in_group(user: str) -> bool:
    try:
        group = grp.getgrnam(GROUP)
    except KeyError:
        return False
    return user in group.gr_mem or pwd.getpwnam(user).pw_gid == group.gr_gid


def _service_active() -> bool:
    tool = shutil.which("systemctl", path=_TOOLS)
    if tool is None:
        return False
    ended = captured([tool, "is-active", SERVICE], COMMAND_TIMEOUT_S)
    return ended.stdout.strip() in ("active", "activating", "deactivating", "reloading")


def _run(command: Command, report: Report) -> None:
    """Run a command; raises InstallError if a required one failed."""
    tool = shutil.which(command.argv[0], path=_TOOLS)
    why = ""
    if tool is None:
        why = "no such program"
    else:
        try:
            env = {**os.environ, "LC_ALL": "C", "PATH": _TOOLS}
            ended = captured([tool, *command.argv[1:]], COMMAND_TIMEOUT_S, env)
            if ended.returncode != 0:
                why = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1]
        except (OSError, subprocess.TimeoutExpired) as error:
            why = str(error)
    if not why:
        report(f"ran {command}")
    elif command.needed:
        raise InstallError(f"{command}: {why}")
    else:
        report(f"{command} failed ({why}); the next boot has the same effect")
