"""Memory that the system and its control groups leave free."""

import sys

import pytest

from pachon.core.memory import available_bytes, readable

MEMINFO = "MemTotal:       24000000 kB\nMemFree:         100 kB\nMemAvailable:   20000000 kB\n"


@pytest.fixture
def system(tmp_path):
    """Return a function that writes files as Linux has them, and the root they are under."""

    def make(**files):
        (tmp_path / "proc/self").mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            path = tmp_path / name.replace("__", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return make


def write(root, folder, **files):
    (root / folder).mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (root / folder / name.replace("_", ".", 1)).write_text(text)


def test_without_limits_the_machine_decides(system):
    assert available_bytes(system(proc__meminfo=MEMINFO)) == 20000000 * 1024


def test_a_system_that_does_not_say_is_unknown(system):
    assert available_bytes(system()) is None
    assert available_bytes(system(proc__meminfo="MemAvailable: lots\n")) is None


@pytest.mark.parametrize(
    ("own", "above", "expected"),
    [
        ("max\n", "max\n", 20000000 * 1024),
        # 3 GB less the 1 GB in use, of which 0.5 GB are cached files.
        ("3000000000\n", "max\n", 2_500_000_000),
        ("max\n", "2000000000\n", 1_500_000_000),
        ("900000000\n", "max\n", 400_000_000),
    ],
)
def test_limits_of_control_groups_and_of_those_above_them(system, own, above, expected):
    root = system(proc__meminfo=MEMINFO, proc__self__cgroup="0::/job/step\n")
    for folder, limit in (("job/step", own), ("job", above)):
        where = f"sys/fs/cgroup/{folder}"
        write(
            root,
            where,
            memory_max=limit,
            memory_current="1000000000\n",
            memory_stat="anon 5\ninactive_file 500000000\n",
        )
    assert available_bytes(root) == expected


def test_limits_of_the_first_version_and_of_a_container(system):
    root = system(proc__meminfo=MEMINFO, proc__self__cgroup="9:name=systemd:/\n4:cpu,memory:/docker/abc\n0::/\n")
    # Inside the container, its own group is the base.
    write(
        root,
        "sys/fs/cgroup/memory",
        memory_limit_in_bytes="4000000000\n",
        memory_usage_in_bytes="1000000000\n",
        memory_stat="inactive_file 1\ntotal_inactive_file 250000000\n",
    )
    assert available_bytes(root) == 3_250_000_000
    # No limit is a very large one.
    write(root, "sys/fs/cgroup/memory", memory_limit_in_bytes="9223372036854771712\n")
    assert available_bytes(root) == 20000000 * 1024
    # Used up, and more.
    write(root, "sys/fs/cgroup/memory", memory_limit_in_bytes="500000000\n")
    assert available_bytes(root) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="known on Linux only")
def test_this_machine_has_some_memory():
    # A test run needs a gigabyte itself; and nothing has a petabyte.
    assert 1e8 < available_bytes() < 1e15


def test_sizes_are_readable():
    assert [readable(n) for n in (5e6, 123456789, 0.96e9, 2.34e9, 21.4e9, 109.9e9)] == [
        "5.0 MB",
        "123 MB",
        "1.0 GB",
        "2.3 GB",
        "21 GB",
        "110 GB",
    ]
