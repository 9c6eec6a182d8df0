"""`companion install` in a scratch root: twice, undone, failed half way, with changes by others."""

from __future__ import annotations

import errno
import json
import os
import pwd
import shutil
import stat
from pathlib import Path

import pytest

from companion.cli.main import main
from companion.install import apply
from companion.install.plan import Command
from companion.install.record import RECORD_PATH
from companion.install.state import InstallError, PathState, write_state
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from tests.commands import companion, refused
from tests.support import ROOT, Ended

UNIT = "etc/systemd/system/companion.service"
RULES = "etc/udev/rules.d/99-companion.rules"
MISSION = "/etc/companion/missions/hover.yaml"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A small system before the installation: files of a flight, foreign udev rules, and a file that will be replaced."""
    root = tmp_path / "root"
    for folder in ("missions", "vehicles", "controllers"):
        shutil.copytree(ROOT / "configs" / folder, root / "etc/companion" / folder)
    vehicle = root / "etc/companion/vehicles/tarot650_2r.yaml"
    text = vehicle.read_text(encoding="utf-8")
    assert "interface: 0.0.0.0 " in text, "of every network: the service would refuse to fly"
    vehicle.write_text(text.replace("interface: 0.0.0.0 ", "interface: 192.0.2.7 "), encoding="utf-8")
    (root / RULES).parent.mkdir(parents=True)
    (root / RULES).write_bytes(b"# by hand, in Latin-1: \xe4\n")
    (root / RULES).chmod(0o640)
    (root / "etc/udev/rules.d/10-mine.rules").write_text("# mine\n")
    (root / "etc/security").mkdir()
    return root


def tree(root: Path) -> dict[str, tuple[str, int, bytes]]:
    """Return kind, mode and content of all files below a folder."""
    found = {}
    for path in sorted(root.rglob("*")):
        status = path.lstat()
        if stat.S_ISLNK(status.st_mode):
            entry = ("link", 0, os.readlink(path).encode())
        elif path.is_dir():
            entry = ("folder", stat.S_IMODE(status.st_mode), b"")
        else:
            entry = ("file", stat.S_IMODE(status.st_mode), path.read_bytes())
        found[str(path.relative_to(root))] = entry
    return found


def install(root: Path, *more: str, code: int = EXIT_OK) -> Ended:
    return companion("install", "--systemd", "--root", root, "--mission", MISSION, "--yes", *more, code=code)


def undo(root: Path, *more: str, code: int = EXIT_OK) -> Ended:
    return companion("install", "--undo", "--root", root, "--yes", *more, code=code)


def test_a_vehicle_file_that_the_service_would_refuse_is_refused_now(root: Path) -> None:
    shutil.copytree(ROOT / "configs/vehicles", root / "etc/companion/vehicles", dirs_exist_ok=True)
    before = tree(root)
    assert "interface" in install(root, code=EXIT_BAD_INPUT).err
    assert tree(root) == before


def test_installed_and_undone_leaves_every_byte_as_it_was(root: Path) -> None:
    before = tree(root)
    install(root, "--arm-serial", "FT4THVLI", "--at-boot")
    after = tree(root)
    changed = {path for path in after if after[path] != before.get(path) and after[path][0] != "folder"}
    assert changed == {
        RULES, UNIT, RECORD_PATH.lstrip("/"), "etc/modules-load.d/companion.conf", "etc/security/limits.d/companion.conf",
        "etc/sysusers.d/companion.conf", "etc/systemd/system/companion-performance.service",
        "etc/systemd/system/multi-user.target.wants/companion.service",
        "etc/systemd/system/multi-user.target.wants/companion-performance.service",
    }  # fmt: skip
    assert 'ATTRS{serial}=="FT4THVLI", SYMLINK+="companion-arm"' in after[RULES][2].decode()
    assert after[RULES][1] == 0o644
    assert after[RECORD_PATH.lstrip("/")][1] == 0o600
    undo(root)
    assert tree(root) == before


def test_a_second_time_there_is_nothing_to_do(root: Path) -> None:
    install(root)
    first = tree(root)
    assert "nothing to do" in install(root).out
    assert tree(root) == first


def test_a_dry_run_shows_every_byte_and_changes_none(root: Path) -> None:
    before = tree(root)
    told = install(root, "--dry-run", "--force-serial", "A10M").out
    assert tree(root) == before
    install(root, "--force-serial", "A10M")
    for path in (RULES, UNIT, "etc/security/limits.d/companion.conf"):
        for line in (root / path).read_text().splitlines():
            assert not line or f"    {line}\n" in told
    assert f"replaces  /{RULES}" in told
    undo(root, "--dry-run")
    assert (root / UNIT).exists()


def test_installed_otherwise_and_undone_is_as_before_the_first_time(root: Path) -> None:
    before = tree(root)
    install(root, "--at-boot", "--user", "pilot")
    assert "User=pilot" in (root / UNIT).read_text()
    install(root, "--arm-serial", "FT1")
    wants = root / "etc/systemd/system/multi-user.target.wants"
    assert [path.name for path in wants.iterdir()] == ["companion-performance.service"]
    assert "User=companion" in (root / UNIT).read_text()
    undo(root)
    assert tree(root) == before


@pytest.mark.parametrize("obstacle", ["etc/security", "etc/systemd", "var", "var/lib/companion/installed.json"])
def test_what_fails_half_way_is_put_back(root: Path, obstacle: str) -> None:
    """A file where a folder is needed, or the reverse, at the start, in the middle and at the end."""
    path = root / obstacle
    if obstacle.endswith(".json"):
        path.mkdir(parents=True)
    else:
        shutil.rmtree(path, ignore_errors=True)
        path.write_text("in the way\n")
    before = tree(root)
    ended = install(root, code=EXIT_REFUSED)
    assert tree(root) == before
    [line] = ended.err_lines
    assert path.name in line


class PowerLossError(BaseException):
    """A loss of power: no handler restores anything."""


def fail_at_the_third_file(monkeypatch: pytest.MonkeyPatch, failure: BaseException) -> None:
    written: list[Path] = []

    def until_then(path: Path, state: PathState) -> None:
        written.append(path)
        if len(written) == 3:
            raise failure
        write_state(path, state)

    monkeypatch.setattr(apply, "write_state", until_then)


@pytest.mark.parametrize(
    ("failure", "code"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/etc/x"), EXIT_REFUSED),
        (OSError(errno.ENOSPC, "No space left on device"), EXIT_REFUSED),
        (KeyboardInterrupt(), EXIT_ABORTED),
    ],
    ids=["full disk", "full standard output", "Ctrl-C"],
)
def test_a_failure_half_way_leaves_everything_as_it_was(
    root: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException, code: int
) -> None:
    before = tree(root)
    fail_at_the_third_file(monkeypatch, failure)
    ended = install(root, code=code)
    assert tree(root) == before
    assert "None" not in ended.err


def test_a_change_that_fails_half_way_leaves_the_first_installation(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tree(root)
    install(root)
    first = tree(root)
    with monkeypatch.context() as patch:
        fail_at_the_third_file(patch, OSError(errno.EIO, os.strerror(errno.EIO), "/etc/x"))
        install(root, "--user", "pilot", "--arm-serial", "FT1", "--at-boot", code=EXIT_REFUSED)
    assert tree(root) == first
    undo(root)
    assert tree(root) == before


def test_what_was_cut_off_half_way_is_undone(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = tree(root)
    fail_at_the_third_file(monkeypatch, PowerLossError())
    with pytest.raises(PowerLossError):
        install(root)
    assert tree(root) != before
    undo(root)
    assert tree(root) == before


def test_a_file_that_somebody_changed_is_not_overwritten(root: Path) -> None:
    install(root)
    (root / UNIT).write_text((root / UNIT).read_text() + "Nice=0\n")
    changed = tree(root)
    for more in (("--undo",), ("--systemd", "--mission", MISSION, "--arm-serial", "FT1")):
        line = refused(EXIT_REFUSED, "install", *more, "--root", root, "--yes")
        assert f"/{UNIT}: was modified after" in line
        assert tree(root) == changed


def test_a_folder_that_others_use_by_now_is_kept(root: Path) -> None:
    install(root)
    (root / "var/lib/companion/fly").mkdir()
    ended = undo(root)
    assert (root / "var/lib/companion/fly").is_dir()
    assert not (root / RECORD_PATH.lstrip("/")).exists()
    assert "kept /var/lib/companion" in ended.out


def test_a_record_that_others_could_write_is_not_trusted(root: Path) -> None:
    install(root)
    (root / RECORD_PATH.lstrip("/")).chmod(0o666)
    assert "not trusted" in undo(root, code=EXIT_REFUSED).err
    (root / RECORD_PATH.lstrip("/")).chmod(0o600)
    (root / RECORD_PATH.lstrip("/")).write_text("{}")
    assert "not a valid record" in undo(root, code=EXIT_REFUSED).err


@pytest.mark.parametrize("goes", [True, False], ids=["the user is deleted", "the user stays"])
def test_keys_go_with_the_user_who_is_deleted_and_stay_with_one_who_stays(
    root: Path, tmp_path: Path, goes: bool
) -> None:
    """A free user id is assigned to the next user, who must not find operator keys."""
    install(root)
    path = root / RECORD_PATH.lstrip("/")
    record = json.loads(path.read_text())
    record["users"] = [pwd.getpwuid(os.geteuid()).pw_name] if goes else []
    path.write_text(json.dumps(record))
    home, others = root / apply.HOME.lstrip("/"), tmp_path / "others"
    keys, log = home / ".config/companion/operators.yaml", home / "flights/1/flight.mcap"
    for file in (keys, log, others / "secret"):
        file.parent.mkdir(parents=True)
        file.write_text("key")
    (home / ".config/elsewhere").symlink_to(others)
    (home / "flights/elsewhere").symlink_to(others)
    ended = undo(root)
    assert keys.exists() is not goes
    assert log.exists() and (others / "secret").exists()
    assert ("the service's keys" in ended.out) is goes


def test_without_a_yes_nothing_is_done(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = tree(root)
    for answer in ("n", "", EOFError(), KeyboardInterrupt()):

        def asked(prompt: str, answer: object = answer) -> str:
            if isinstance(answer, BaseException):
                raise answer
            return str(answer)

        monkeypatch.setattr("builtins.input", asked)
        assert main(["install", "--systemd", "--root", str(root), "--mission", MISSION]) == EXIT_ABORTED
    assert tree(root) == before
    monkeypatch.setattr("builtins.input", lambda prompt: "y")
    assert main(["install", "--systemd", "--root", str(root), "--mission", MISSION]) == EXIT_OK
    assert tree(root) != before


def test_json_is_all_that_is_printed(root: Path) -> None:
    told = json.loads(install(root, "--json", "--dry-run").out)
    assert not told["done"]
    assert told["commands"] == []  # of a root that is not this computer's
    assert [file["path"] for file in told["files"] if file["replaces"]] == [f"/{RULES}"]
    assert json.loads(install(root, "--json").out)["done"]
    assert not json.loads(install(root, "--json").out)["done"]
    assert f"/{UNIT}" in json.loads(undo(root, "--json").out)["files"]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--user", "root"), "not root"),
        (("--user", "a b"), "expected a user name"),
        (("--arm-serial", 'X", RUN+="/bin/sh'), "serial number"),
        (("--mission", "/etc/companion/none.yaml"), "no such file"),
        (("--mission", "/home/pi/hover.yaml"), "cannot see /home"),
        (("--mission", "/etc/companion/vehicles/tarot650_2r.yaml"), "tarot650_2r.yaml"),
        (("--root", "/nowhere/at/all"), "expected the root folder"),
    ],
)
def test_wrong_input_is_refused(root: Path, arguments: tuple[str, ...], why: str) -> None:
    before = tree(root)
    assert why in install(root, *arguments, code=EXIT_BAD_INPUT).err
    assert tree(root) == before


def test_a_vehicle_that_nobody_could_command_is_refused(root: Path) -> None:
    vehicle = root / "etc/companion/vehicles/tarot650_2r.yaml"
    text = vehicle.read_text()
    head, _, _ = text.partition("\nground:")
    vehicle.write_text(head + "\nground:\n  mqtt: null\n")
    assert "commands are not possible" in install(root, code=EXIT_BAD_INPUT).err


def test_a_mission_that_the_service_could_not_read_is_refused(root: Path) -> None:
    (root / "etc/companion/missions").chmod(0o700)
    assert "chmod o+rX" in install(root, code=EXIT_BAD_INPUT).err


def test_commands_run_with_a_fixed_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Root's tools do not come from the PATH of the user who called sudo."""
    monkeypatch.setenv("PATH", "/tmp/others")
    command = Command(("sh", "-c", "echo $PATH >&2; exit 1"), "shows its path", needed=True)
    with pytest.raises(InstallError, match=r": /usr/sbin:/sbin:/usr/bin:/bin$"):
        apply._run(command, lambda _: None)
