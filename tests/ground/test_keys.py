"""Files with secrets: created once, readable by their owner alone, and refused in one line that shows no secret."""

from __future__ import annotations

import base64
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from companion.config.document import ConfigError
from companion.ground.protocol.keys import (
    Operator,
    Permission,
    default_operators_file,
    load_login,
    load_operators,
    new_key,
    operators_text,
    write_private,
)
from companion.model.types import OperatorCommand
from tests.support import DEADLINE_S, ROOT

KEY = base64.b64encode(bytes(range(32))).decode()
OTHER = base64.b64encode(bytes(32)).decode()


def private(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)
    return path


def one_operator(**values: str) -> str:
    entry = {"name": "anna", "key": KEY, **values}
    return "version: 1\noperators:\n  - " + "\n    ".join(f"{key}: {value}" for key, value in entry.items()) + "\n"


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


def test_written_file_reads_back(tmp_path: Path) -> None:
    made = [
        Operator("anna", new_key()),
        Operator("1e3", new_key(), Permission.SAFER_COMMANDS),
        Operator("null", new_key()),
    ]
    write_private(tmp_path / "operators.yaml", operators_text(made).encode())
    operators = load_operators(tmp_path / "operators.yaml")
    assert operators.names == ("anna", "1e3", "null")
    assert [operators.key(one.name) for one in made] == [one.key for one in made]
    assert operators.is_allowed("anna", OperatorCommand.START)
    assert operators.is_allowed("1e3", OperatorCommand.ABORT)
    assert not operators.is_allowed("1e3", OperatorCommand.RESUME)
    assert not operators.is_allowed("nobody", OperatorCommand.HOLD)
    assert operators.find_key("nobody") is None
    with pytest.raises(ConfigError, match="no operator 'nobody'; expected one of anna, 1e3, null"):
        operators.key("nobody")


def test_users_own_file_is_made_once_and_private(home: Path) -> None:
    first = load_operators()
    assert default_operators_file() == home / "config/companion/operators.yaml"
    assert stat.S_IMODE(default_operators_file().stat().st_mode) == 0o600
    assert stat.S_IMODE(default_operators_file().parent.stat().st_mode) == 0o700
    assert len(first.names) == 1
    assert len(first.key(first.names[0])) == 32
    assert load_operators().key(first.names[0]) == first.key(first.names[0])
    assert [path.name for path in default_operators_file().parent.iterdir()] == ["operators.yaml"]


def test_key_files_are_private_whatever_the_umask_is(home: Path) -> None:
    before = os.umask(0)
    try:
        load_operators()
    finally:
        os.umask(before)
    assert stat.S_IMODE(default_operators_file().stat().st_mode) == 0o600
    assert stat.S_IMODE(default_operators_file().parent.stat().st_mode) == 0o700


def test_processes_that_start_at_once_share_one_key(home: Path) -> None:
    program = (
        "import sys; from companion.ground.protocol.keys import load_operators\n"
        "print('ready', flush=True); sys.stdin.readline(); o = load_operators(); print(o.key(o.names[0]).hex())"
    )
    environment = {**os.environ, "XDG_CONFIG_HOME": str(home / "config")}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=ROOT,
        )
        for _ in range(3)
    ]
    for process in started:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in started:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    keys = {process.communicate(timeout=DEADLINE_S)[0] for process in started}
    assert [process.returncode for process in started] == [0] * 3
    assert len(keys) == 1
    assert [path.name for path in default_operators_file().parent.iterdir()] == ["operators.yaml"]


def test_relative_xdg_folder_is_ignored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_operators_file() == tmp_path / ".config/companion/operators.yaml"


def test_own_file_that_cannot_be_made_is_one_line(home: Path) -> None:
    (home / "config").write_text("a file where a folder should be")
    with pytest.raises(ConfigError, match=r"operators.yaml: .*; give another file") as refused:
        load_operators()
    assert len(refused.value.lines) == 1


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o610, 0o601])
def test_file_open_to_others_is_refused_with_the_fix(tmp_path: Path, mode: int) -> None:
    path = private(tmp_path / "operators.yaml", one_operator(), mode)
    for load in (load_operators, load_login):
        with pytest.raises(
            ConfigError, match=f"accessible to others .mode {mode:04o}.; run: chmod 600 {path}"
        ) as refused:
            load(path)
        assert len(refused.value.lines) == 1


def test_home_folder_is_known_by_its_sign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    private(tmp_path / "operators.yaml", one_operator(), mode=0o400)
    assert load_operators("~/operators.yaml").names == ("anna",)


BAD = {
    "no key": ("version: 1\noperators:\n  - name: anna\n", r":3:5: operators\[0\].key: missing"),
    "short key": (
        one_operator(key="c2hvcnQ="),
        r":4:10: operators\[0\].key: expected base64 of 32 random bytes; found 5 bytes",
    ),
    "no base64": (one_operator(key="'!!!!'"), r"operators\[0\].key: expected base64 of 32 random bytes"),
    "key is a number": (one_operator(key="12345678"), r"operators\[0\].key: expected text; put it in quotes"),
    "bad name": (one_operator(name="'anna smith'"), r":3:11: operators\[0\].name: expected 1 to 40 letters"),
    "topic wildcard": (one_operator(name="'+'"), r"operators\[0\].name: expected 1 to 40 letters"),
    "may anything": (one_operator(may="everything"), r"operators\[0\].may: .*safer.*all"),
    "version": (one_operator().replace("version: 1", "version: 2"), r":1:10: version: expected 1"),
    "mapping of operators": (f"version: 1\noperators:\n  anna: {KEY}\n", r"operators: expected a list"),
    "list of keys": (f"version: 1\noperators:\n  - {KEY}\n", r"operators\[0\]: expected a mapping"),
    "key in a list": (one_operator(key=f"[{KEY}]"), r"operators\[0\].key: expected text"),
    "key as the version": (f"version: {KEY}\noperators: []\n", r"version: expected 1"),
    "nobody": ("version: 1\noperators: []\n", r":2:12: operators: "),
    "twice": (
        one_operator() + f"  - name: anna\n    key: {OTHER}\n",
        r":5:11: operators\[1\].name: anna is in the file twice",
    ),
    "same key": (
        one_operator() + f"  - name: bert\n    key: {KEY}\n",
        r":6:10: operators\[1\].key: another operator has the same",
    ),
}


@pytest.mark.parametrize(("text", "line"), BAD.values(), ids=BAD)
def test_bad_operators_file_is_explained_without_a_secret(tmp_path: Path, text: str, line: str) -> None:
    with pytest.raises(ConfigError, match=line) as refused:
        load_operators(private(tmp_path / "operators.yaml", text))
    assert len(refused.value.lines) <= 2
    for told in refused.value.lines:
        assert told.startswith(str(tmp_path / "operators.yaml"))
        assert not any(secret in told for secret in (KEY, OTHER, "c2hvcnQ", "12345678", "!!!!"))


def test_missing_files_and_folders_are_one_line(tmp_path: Path) -> None:
    for path, line in ((tmp_path / "none.yaml", "no such file"), (tmp_path, "is a directory")):
        for load in (load_operators, load_login):
            with pytest.raises(ConfigError, match=line) as refused:
                load(path)
            assert len(refused.value.lines) == 1


def test_login_file(tmp_path: Path) -> None:
    login = load_login(private(tmp_path / "anna.yaml", 'username: anna\npassword: "0123"\n'))
    assert (login.username, login.password) == ("anna", "0123")
    with pytest.raises(ConfigError, match="password: expected text; put it in quotes") as refused:
        load_login(private(tmp_path / "anna.yaml", "username: anna\npassword: 987654\n"))
    assert "987654" not in str(refused.value)


def test_secrets_are_not_shown(tmp_path: Path) -> None:
    operators = load_operators(private(tmp_path / "operators.yaml", one_operator()))
    login = load_login(private(tmp_path / "anna.yaml", "username: anna\npassword: hush-hush\n"))
    shown = f"{operators!r} {operators} {Operator('anna', operators.key('anna'))!r} {login!r} {login}"
    assert "anna" in shown
    assert "hush" not in shown
    assert KEY not in shown
    assert "\\x01\\x02" not in shown
