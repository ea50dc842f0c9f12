"""Finding libLLVM and saying what is missing, in processes of their own: none aborts or shows a traceback."""

import ctypes
import inspect
import mmap
import os
import platform
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from spacesim import backend, doctor
from spacesim.backend import llvm, memory, recording
from spacesim.backend.flattening import flattener

FAKE = "void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c) {{ *a = {}; *b = 1; *c = 7; }}\n"


def run(program: str, **environment: str) -> str:
    """What a Python program prints; it must end well and say nothing on stderr but Dr.Jit's own log."""
    inherited = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, env=inherited | environment, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout.strip()


def find_in(folder: Path) -> str:
    """What find_llvm prints where only `folder` is looked into and nobody has named a library."""
    places = (f"{folder}/libLLVM*.so*",)
    return run(f"""
import os
from spacesim import backend
from spacesim.backend import llvm
os.environ.pop("DRJIT_LIBLLVM_PATH", None)  # named by the package when it was imported
llvm._candidates.cache_clear()
llvm._LIBRARY_PLACES = {places!r}
print(*backend.find_llvm())
""")


@pytest.fixture(scope="module")
def fakes(tmp_path_factory) -> Path:
    """A folder of libraries that report versions 15, 16, 20 and 21 as libLLVM does."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler makes libraries to find")
    folder = tmp_path_factory.mktemp("fakes")
    for version in (15, 16, 20, 21):
        source = folder / f"{version}.c"
        source.write_text(FAKE.format(version))
        library = folder / f"libLLVM-{version}.so"
        subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source], check=True)
    return folder


def test_newest_is_taken(fakes):
    path, sentence = find_in(fakes).split(" ", 1)
    assert path == str(fakes / "libLLVM-21.so")
    assert sentence == f"libLLVM 21 at {path}"


def test_all_ways_of_naming_are_known(fakes, tmp_path):
    for name in ("libLLVM-20.so", "libLLVM-20.so.1", "libLLVM.so.20.1", "libLLVM.so.20", "libLLVM-20.1.7.so"):
        folder = tmp_path / name.replace(".", "_")
        folder.mkdir()
        shutil.copy(fakes / "libLLVM-20.so", folder / name)
        assert find_in(folder).startswith(str(folder / name)), name


def test_old_and_broken_libraries_are_passed_over(fakes, tmp_path):
    (tmp_path / "libLLVM-22.so").write_bytes(b"no library")
    (tmp_path / "libLLVM-19.so").symlink_to("absent")
    shutil.copy(fakes / "libLLVM-16.so", tmp_path / "libLLVM-23.so")  # says that it is 16
    for version in (15, 16):
        shutil.copy(fakes / f"libLLVM-{version}.so", tmp_path)
    found = find_in(tmp_path)
    assert found.startswith("None libLLVM 19 or newer is needed")
    assert "15, 16" in found
    shutil.copy(fakes / "libLLVM-20.so", tmp_path)
    assert find_in(tmp_path).startswith(str(tmp_path / "libLLVM-20.so"))


def test_nothing_to_find(tmp_path):
    assert find_in(tmp_path) == (f"None libLLVM 19 or newer is needed, found none; type: {llvm.INSTALL_LLVM}")


def test_named_library(fakes):
    program = "from spacesim import backend; print(*backend.find_llvm())"
    good = fakes / "libLLVM-20.so"
    assert run(program, DRJIT_LIBLLVM_PATH=str(good)) == f"{good} libLLVM 20 at {good}"
    for bad in (fakes / "libLLVM-16.so", fakes / "absent.so", fakes / "16.c"):
        found = run(program, DRJIT_LIBLLVM_PATH=str(bad))
        assert found.startswith("None DRJIT_LIBLLVM_PATH names ")
        assert "19 or newer" in found


def old_library() -> str | None:
    """A real libLLVM older than 19, if this machine has one."""
    for pattern in llvm._LIBRARY_PLACES:
        for path in Path("/").glob(pattern.lstrip("/")):
            match = re.search(r"libLLVM(?:-|\.so\.)(\d+)", path.name)
            if match and 14 <= int(match.group(1)) < llvm.MIN_LLVM:
                return str(path)
    return None


LOADED = """
{imports}
import drjit as dr
from drjit.llvm import Float
print(dr.minimum(Float(2, 3), Float(1, 4)))  # aborts the process with an old library
print(*sorted({{line.split()[-1] for line in open("/proc/self/maps") if "libLLVM" in line}}))
"""


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="no /proc tells which library is loaded")
@pytest.mark.parametrize(
    "imports",
    ["import spacesim", "import spacesim.splat.raster.render", "import spacesim.scenes.render"],
)
def test_importing_the_package_first_is_enough(imports):
    """A fresh interpreter in which nobody has named a library loads a new one alone, whatever older ones are there."""
    if backend.available()["llvm"] is not None:
        pytest.skip(f"LLVM cannot run here: {backend.available()['llvm']}")
    minima, libraries = run(LOADED.format(imports=imports)).splitlines()
    assert minima == "[1, 3]"
    (library,) = libraries.split()
    assert llvm._library_version(Path(library)) >= llvm.MIN_LLVM


def test_the_newest_is_named_unless_the_user_has_named_one(fakes):
    program = f"""
import os
from spacesim import backend
from spacesim.backend import llvm
os.environ.pop("DRJIT_LIBLLVM_PATH", None)
llvm._candidates.cache_clear()
llvm._LIBRARY_PLACES = ("{fakes}/libLLVM*.so*",)
backend.name_llvm()
print(os.environ["DRJIT_LIBLLVM_PATH"])
os.environ["DRJIT_LIBLLVM_PATH"] = "mine"
backend.name_llvm()
print(os.environ["DRJIT_LIBLLVM_PATH"])
"""
    assert run(program).split() == [str(fakes / "libLLVM-21.so"), "mine"]


def test_only_old_libraries_are_not_named(fakes, tmp_path):
    shutil.copy(fakes / "libLLVM-16.so", tmp_path)
    program = f"""
import os
from spacesim import backend
from spacesim.backend import llvm
os.environ.pop("DRJIT_LIBLLVM_PATH", None)
llvm._candidates.cache_clear()
llvm._LIBRARY_PLACES = ("{tmp_path}/libLLVM*.so*",)
backend.name_llvm()
print(os.environ.get("DRJIT_LIBLLVM_PATH"))
try:
    backend.select("llvm")
except backend.BackendError as error:
    print(error)
"""
    named, sentence = run(program).splitlines()
    assert named == "None"
    assert sentence.startswith("llvm: libLLVM 19 or newer is needed, found only version 16")


def test_an_old_library_ends_in_a_sentence(fakes):
    program = """
from spacesim import backend
try:
    backend.select("llvm")
except backend.BackendError as error:
    print(error)
"""
    found = run(program, DRJIT_LIBLLVM_PATH=old_library() or str(fakes / "libLLVM-16.so"))
    assert found.startswith("llvm: DRJIT_LIBLLVM_PATH names ")
    assert "\n" not in found


def test_doctor_describes_a_machine_without_a_library(fakes):
    program = "from spacesim import doctor; print(doctor.describe(doctor.report()))"
    lines = run(program, DRJIT_LIBLLVM_PATH=old_library() or str(fakes / "libLLVM-16.so")).splitlines()
    assert any(line.startswith("LLVM") and "no: DRJIT_LIBLLVM_PATH names" in line for line in lines)
    assert lines[-1].startswith(("Nothing can be rendered here", "Ready: --backend auto runs on cuda"))


def test_doctor_survives_a_broken_installation(monkeypatch):
    def broken():
        raise ImportError("libcudart is gone")

    monkeypatch.setattr(backend, "available", broken)
    found = doctor.report()
    assert found["backend"] is None
    assert not found["llvm"]["ok"]
    assert "libcudart is gone" in doctor.describe(found)


def test_doctor_agrees_with_the_backend():
    found = doctor.report()
    reasons = backend.available()
    assert {name: found[name]["ok"] for name in reasons} == {name: reasons[name] is None for name in reasons}
    assert found["backend"] in (*reasons, None)
    assert found["versions"]["spacesim"] is not None


def test_select_takes_known_names_alone():
    with pytest.raises(ValueError, match="found 'metal'"):
        backend.select("metal")


def test_recordings_tell_constants_apart_that_occur_twice():
    """Dr.Jit alone replays f(3, 4, 3) for f(3, 4, 4): it knows the last argument as one that it has seen."""
    ad = backend.ad

    def function(x, sizes, extra, flag):
        return x * sizes[0] + 10 * sizes[1] * x + 100 * extra * x + (1000 * x if flag else 0)

    recorded = backend.recorded(function, limit=8)
    for extra in (3, 4):
        for flag in (True, False):
            expected = 3 + 40 + 100 * extra + 1000 * flag
            assert float(recorded(ad.Float(1.0, 2.0), (3, 4), extra, flag)[0]) == expected


def test_constants_are_all_that_is_no_array():
    x = backend.ad.Float(1.0, 2.0)

    def key(value):
        whole = []  # keys of dictionaries, to which 1, 1.0 and True are one
        return recording._split(value, [], whole), tuple(whole)

    kinds = kinds_of_arguments(x)
    assert len({key(value) for value in kinds}) == len(kinds)
    assert key((x, 1)) == key((x + 1, 1))
    assert key(_Pair(1, "a")) == key(_Pair(1, "a")) != key(_Pair(1, "b"))
    changing = _Pair([1])  # frozen itself, what it holds is not
    before = key(changing)
    changing.one.append(2)
    assert key(changing) != before


def kinds_of_arguments(x):
    """No two of the same structure."""
    plain = [(1, x), (1.0, x), (True, x), ("1", x), (None, x), (x, None), ({"a": 1}, x), ({"a": x}, x), ((x,), x)]
    plain += [(0.0, x), (-0.0, x), (_Pair(1), x), (_Pair(1.0), x), (_Pair((1, 2)), x), (_Pair(_Pair(1)), x)]
    return [*plain, ([x], x), ([x, x], x), ([1, x], x), ([[x], [x]], x), ([[x, x]], x), (_Pair(x, 1), x), ([], x)]


def test_code_for_one_structure_takes_the_arrays_of_no_other():
    """Those of its own in the order in which they are walked through."""
    large = [_Pair(tuple(range(10))), _Pair(tuple(range(11)))]
    x, y = (backend.ad.Float(number, 2.0) for number in (1.0, 3.0))
    first, second = ([*kinds_of_arguments(array), *((constant, array) for constant in large)] for array in (x, y))
    for place, value in enumerate(first):
        arrays, others = [], []
        whole = []
        recording._split(value, arrays, [])
        recording._split(second[place], others, whole)
        flatten = flattener((value,), {"n": value}, recording._leaves, recording._constants, recording._field_names)
        for other, given in enumerate(second):
            found = flatten((given,), {"n": given})
            assert (found is None) == (other != place), (value, given)
            if found is not None:
                assert list(map(id, found[0])) == list(map(id, 2 * others))
                assert found[1] == tuple(2 * whole)
        assert flatten((value,), {"m": value}) is flatten((value, value), {"n": value}) is None
        assert len(flatten((value,), {"n": value})[0]) == 2 * len(arrays)


def test_more_structures_than_code_is_kept_for(monkeypatch):
    """In turn, then one again and again."""
    monkeypatch.setattr(recording, "RECORDINGS", 3)
    x = backend.ad.Float(1.0, 2.0)
    scaled = backend.recorded(lambda x, factors: x * sum(factors))
    for count in [*range(6), *range(6), *range(6), 4, 4, 4, 2, 4]:
        assert scaled(x, tuple(range(count))).numpy() == pytest.approx(x.numpy() * sum(range(count)))
    assert len(scaled._flatteners) == 3


def test_code_for_a_structure_serves_all_whole_numbers():
    """Capacities change from view to view."""
    x = backend.ad.Float(1.0, 2.0)
    scaled = backend.recorded(lambda x, pair, number: x * pair.one + number)
    before = backend.recordings()
    for first, second in [(2, 3), (3, 2), (2, 3), (5, 0), (3, 2), (2, 2), (5, 0)]:
        found = scaled(x, _Pair(first), second)
        assert found.numpy() == pytest.approx(first * x.numpy() + second)
    assert len(scaled._flatteners) == 1
    assert backend.recordings() - before == 4


def test_the_first_arrays_of_a_type_have_the_same_key_as_the_next(monkeypatch):
    """Else the second call of a program would record anew."""
    monkeypatch.setattr(recording, "_leaves", set())
    x = backend.ad.Float(1.0, 2.0)
    first, second = (recording._split(([x, x], {"a": [x]}, (x,), [[x], []]), [], []) for _ in range(2))
    assert first == second


@dataclass(frozen=True)
class _Pair:
    one: object
    other: object = None


def test_recorded_functions_get_what_they_are_called_with():
    """Arrays deep within other things, at the first call and at replays."""
    ad, seen = backend.ad, []

    def function(x, things, *rest):
        seen.append((things, rest))
        first = things["rows"]
        return {"sum": [a + x * b for a, b in first], "rest": _Pair(rest[0].one[1] - x, rest[0].other)}

    recorded = backend.recorded(function, limit=4)
    for k in (1, 2):
        x, y, z = (ad.Float(k, 2.0 * k, i) for i in range(3))
        v = ad.Array2f(ad.Float(1.0, k, 0), ad.Float(0.0, k, 5))
        found = recorded(x, {"rows": [(y, z)], "n": None}, _Pair((3, v, "a"), _Pair(None, 2.5)))
        assert found["sum"][0].numpy() == pytest.approx((y + x * z).numpy())
        assert found["rest"].one.numpy() == pytest.approx((v - x).numpy())
        assert found["rest"].other == _Pair(None, 2.5)
    assert len(seen) == 1
    things, (pair,) = seen[0]
    assert (things["n"], type(things["rows"][0]), pair.one[::2]) == (None, tuple, (3, "a"))


def test_a_recorded_function_is_traced_where_no_recording_serves():
    """One element, none, gradients, and within another recording."""
    import drjit as dr

    ad, seen = backend.ad, []

    @backend.recorded
    def scaled(x, factor=2.0):
        """`x` times a number."""
        seen.append(dr.width(x))
        return factor * x

    assert (scaled.__doc__, list(inspect.signature(scaled).parameters)) == ("`x` times a number.", ["x", "factor"])
    three, one = ad.Float(1.0, 2.0, 3.0), ad.Float(4.0)
    for _ in range(2):
        assert scaled(three).numpy() == pytest.approx([2, 4, 6])
        assert scaled(three, factor=3.0).numpy() == pytest.approx([3, 6, 9])
    assert seen == [3, 3]  # each factor once
    for _ in range(2):
        assert scaled(one).numpy() == pytest.approx([8])
    assert seen == [3, 3, 1, 1]
    leaf = ad.Float(three)
    dr.enable_grad(leaf)
    dr.backward(scaled(leaf))
    assert dr.grad(leaf).numpy() == pytest.approx([2, 2, 2])
    assert scaled.traced(three).numpy() == pytest.approx([2, 4, 6])

    before, outer = backend.recordings(), backend.recorded(lambda x: scaled(x) + 1)
    assert [list(outer(three + i).numpy()) for i in range(2)] == [[3, 5, 7], [5, 7, 9]]
    assert backend.recordings() == before + 1


OTHER_THREADS = """
import faulthandler, sys, threading
from dataclasses import dataclass
import drjit as dr
from spacesim import backend
from spacesim.backend.arrays import Float
from spacesim.learning.networks.network import MlpShape
from spacesim.splat.light import cooperative

faulthandler.dump_traceback_later(60, exit=True)
ad, done = backend.ad, threading.Event()

@dataclass
class Pair:
    first: Float
    rest: object

@backend.recorded
def both(x, network):
    return Pair(x + 1, Pair([2 * x], {"three": 3 * x}))

def work():
    while not done.is_set():
        del [ad.Float(float(i)) for i in range(50)][:]

threads = [threading.Thread(target=work) for _ in range(2)]
sys.setswitchinterval(1e-6)
for thread in threads:
    thread.start()
x = dr.arange(ad.Float, 100)
network = cooperative.pack(MlpShape(2, 1, 1, 4, 2), [dr.zeros(ad.Float, n) for n in (4, 8, 4, 4, 1)])
for _ in range(20_000):
    found = both(x, network)
done.set()
for thread in threads:
    thread.join()
print(found.rest.rest["three"].numpy().sum(), len(found.rest.first))
"""


MAKES_ARRAYS = """
import resource, sys
import numpy as np
from spacesim.backend.memory import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
for turn in range(4):
    arrays = [np.ones(3 << 20, np.uint8) for _ in range(12)]
    del arrays
    if turn == 1:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc alone")
def test_freed_memory_serves_the_next_arrays():
    def faults(how: str) -> int:
        done = subprocess.run([sys.executable, "-c", MAKES_ARRAYS, how], capture_output=True, text=True, check=True)
        return int(done.stdout)

    assert faults("keep") < 200 < faults("give back")


def test_recordings_do_not_wait_for_threads_that_wait_for_them():
    """Dr.Jit holds its lock while it looks into arguments and puts results together: what runs Python there lets others
    run, which wait for that with Python's lock."""
    assert run(OTHER_THREADS).split() == ["14850.0", "1"]


def test_the_size_of_recorded_elements_can_be_given():
    import drjit as dr

    ad, seen = backend.ad, []

    def summed(x, width):
        seen.append(width)
        return dr.gather(ad.Float, x, dr.arange(ad.UInt32, width))

    by_width = backend.recorded(summed, elements=lambda _, x, width: width)
    x = ad.Float(1.0, 2.0, 3.0)
    for width in (2, 1, 2, 1):
        assert list(by_width(x, width).numpy()) == [1, 2][:width]
    assert seen == [2, 1, 1]
    always = backend.recorded(lambda x: seen.append("one") or x + 1, elements=None)
    assert [float(always(dr.opaque(ad.Float, i))[0]) for i in range(3)] == [1, 2, 3]
    assert seen[3:] == ["one"]


@pytest.mark.parametrize(
    ("files", "left"),
    [
        ({}, 8_000_000_000),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/memory.max": "max\n"}, 8_000_000_000),
        (  # a container with control groups of version 2: a gigabyte, 600 MB of it used, 100 MB of these a file's
            {
                "proc/self/cgroup": "0::/\n",
                "sys/fs/cgroup/memory.max": "1000000000\n",
                "sys/fs/cgroup/memory.current": "600000000\n",
                "sys/fs/cgroup/memory.stat": "anon 500000000\ninactive_file 100000000\n",
            },
            500_000_000,
        ),
        (  # a job of a batch system, whose limit is that of the group above
            {
                "proc/self/cgroup": "5:cpu:/\n4:memory:/slurm/job_7/step_0\n0::/\n",
                "sys/fs/cgroup/memory/slurm/job_7/step_0/memory.limit_in_bytes": "9223372036854771712\n",
                "sys/fs/cgroup/memory/slurm/job_7/step_0/memory.usage_in_bytes": "200000000\n",
                "sys/fs/cgroup/memory/slurm/job_7/memory.limit_in_bytes": "2000000000\n",
                "sys/fs/cgroup/memory/slurm/job_7/memory.usage_in_bytes": "300000000\n",
            },
            1_700_000_000,
        ),
    ],
)
def test_main_memory_is_what_the_control_groups_leave(tmp_path, files, left):
    for name, content in {"proc/meminfo": "MemTotal: 16000000 kB\nMemAvailable: 7812500 kB\n", **files}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    assert backend.main_memory(tmp_path) == left


@pytest.mark.skipif(os.name != "posix", reason="other systems have no such limit")
def test_main_memory_is_no_more_than_the_address_space_that_is_left(tmp_path, monkeypatch):
    import resource

    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemAvailable: 7812500 kB\n")
    (tmp_path / "proc/self/status").write_text("Name:\tpython\nVmSize:\t 1000000 kB\n")
    for limit, left in ((resource.RLIM_INFINITY, 8 * 10**9), (4 * 10**9, 4 * 10**9 - 1_024_000_000), (10**9, 0)):
        monkeypatch.setattr(resource, "getrlimit", lambda _, most=limit: (most, most))
        assert backend.main_memory(tmp_path) == left


def test_freed_arrays_are_given_back_before_memory_counts_as_short(monkeypatch):
    import drjit as dr

    given_back: list[bool] = []
    asked = "device_memory" if backend.select() == "cuda" else "main_memory"
    monkeypatch.setattr(memory, asked, lambda: 500 if given_back else 100)
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: given_back.append(True))
    assert (backend.free_memory(), backend.free_memory(100), given_back) == (100, 100, [])
    assert (backend.free_memory(101), given_back) == (500, [True])


@pytest.mark.gpu
def test_device_memory_falls_with_what_is_taken():
    if backend.select() != "cuda":
        pytest.skip("needs a CUDA device")
    import drjit as dr

    taken = 1 << (backend.free_memory(10**18) // 8).bit_length() - 1  # far more than others take meanwhile
    for _ in range(20):  # others may give memory back just then
        before = backend.free_memory(10**18)
        array = dr.opaque(backend.ad.Float, 0, taken // 4)
        dr.eval(array)
        dr.sync_thread()
        left = backend.device_memory()
        assert left is not None
        del array
        after = backend.free_memory(10**18)
        if before - left >= taken - 2**20:
            break
    assert before - left >= taken - 2**20
    assert after > left + taken // 2


@pytest.mark.skipif(sys.platform != "linux", reason="memory is protected by Linux's calls")
@pytest.mark.parametrize("count", [1, 5, 16, 31])
def test_upload_reads_nothing_beyond_the_array(count):
    """Values that end where their page ends, and the next page cannot be read: what a kernel of LLVM dies of."""
    import drjit as dr

    from spacesim.backend.upload import upload

    libc, page = ctypes.CDLL(None, use_errno=True), mmap.PAGESIZE
    pages = mmap.mmap(-1, 2 * page)
    start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    assert libc.mprotect(ctypes.c_void_p(start + page), ctypes.c_size_t(page), 0) == 0
    for kind, dtype in ((backend.ad.Float, np.float32), (backend.ad.UInt32, np.uint32), (backend.ad.Bool, np.bool_)):
        values = np.frombuffer(pages, dtype, count, page - count * np.dtype(dtype).itemsize)
        values[:] = 1
        assert np.array(dr.select(upload(values, kind) == kind(1), backend.ad.Float(2), 3)).tolist() == [2] * count
        del values


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Dr.Jit's library may have other names")
def test_numbers_are_read_without_synchronising():
    import drjit as dr

    from spacesim.backend.readback import AsyncNumber, can_read_async

    assert can_read_async()
    ad = backend.ad
    for turn in range(3):
        wide, few = ((ad.UInt64(1) << 40) + dr.square(dr.arange(ad.UInt64, size)) for size in (1000 + turn, 4))
        squares = dr.square(dr.arange(ad.UInt32, 32))
        dr.eval(wide, few, squares)
        first, last, short = AsyncNumber(few), AsyncNumber(wide), AsyncNumber(squares)
        del wide, few, squares
        assert (short.wait(), last.wait(), first.wait()) == (961, 2**40 + (999 + turn) ** 2, 2**40 + 9)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Dr.Jit's library may have other names")
def test_numbers_wait_for_the_device_and_leave_their_memory_to_the_next(monkeypatch):
    import drjit as dr

    from spacesim.backend import readback

    monkeypatch.setattr(readback, "_slots", [])
    ad = backend.ad

    def launch(k: int):
        values = dr.arange(ad.Float, 2**22) + dr.opaque(ad.Float, 0)
        for _ in range(300):
            values = dr.sin(values) + dr.cos(values)
        last = ad.UInt32(dr.abs(values)) * 0 + dr.opaque(ad.UInt32, k)
        dr.eval(last)
        return last

    for k in range(1, 4):
        number = readback.AsyncNumber(launch(k))
        assert number.wait() == k
    with pytest.raises(AssertionError):
        number.wait()
    assert len(readback._slots) == 1, "the same for all"
    del number
    dropped = readback.AsyncNumber(launch(4))
    assert not readback._slots
    del dropped
    assert len(readback._slots) == 1
    assert ctypes.c_uint32.from_address(readback._slots[0].address).value == 4, "given back when it has arrived"


@pytest.mark.parametrize("library", ["there", "missing", "there, arrays too large"])
def test_arrays_are_read_without_synchronising(monkeypatch, library):
    import drjit as dr

    from spacesim.backend import readback

    if library == "missing":
        monkeypatch.setattr(readback, "can_read_async", lambda: False)
    if library == "there, arrays too large":
        monkeypatch.setattr(readback, "MAX_BYTES", 3)
    ad = backend.ad
    for size in (1, 1000, 1000, 1001):
        ints, floats = dr.square(dr.arange(ad.UInt32, size)), 0.5 * dr.arange(ad.Float, size)
        dr.eval(ints, floats)
        reads = readback.AsyncArray(ints), readback.AsyncArray(floats)
        del ints, floats
        wide, halves = (read.wait() for read in reads)
        assert (wide.dtype, halves.dtype) == (np.uint32, np.float32)
        np.testing.assert_array_equal(halves, np.arange(size) / 2)
        ones = dr.full(ad.UInt32, 1, size)
        dr.eval(ones)
        dropped, last = readback.AsyncArray(ones), readback.AsyncArray(ones)
        del dropped
        assert last.wait().sum() == size
        np.testing.assert_array_equal(wide, np.arange(size, dtype=np.uint32) ** 2, "memory of its own")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Dr.Jit's library may have other names")
def test_numbers_arrive_though_all_are_on_their_way():
    """Memory from which numbers go is written again and again, here before a slow device has read the first."""
    import drjit as dr

    from spacesim.backend import upload
    from spacesim.backend.readback import copy_functions

    outbox, functions = upload._Outbox(), copy_functions()
    assert functions is not None
    lists = [[0.1 * k + n for n in range(1 + k % upload.MAX_NUMBERS)] for k in range(3 * upload.LISTS + 7)]
    slow = dr.arange(backend.ad.Float, 2**22) + dr.opaque(backend.ad.Float, 0)
    for _ in range(100):
        slow = dr.sin(slow) + dr.cos(slow)
    dr.eval(slow)
    sent = [outbox.send(values, functions) for values in lists]
    for values, array in zip(lists, sent, strict=True):
        np.testing.assert_array_equal(np.array(array), np.float32(values))
    for slot, _ in outbox._halves:
        slot.event.wait()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Dr.Jit's library may have other names")
def test_threads_send_numbers_from_the_same_memory():
    from spacesim.backend import upload
    from spacesim.backend.readback import copy_functions

    outbox, functions = upload._Outbox(), copy_functions()

    def send(thread: int) -> bool:
        sent = [outbox.send([thread, k], functions) for k in range(upload.LISTS)]
        return all(np.array(array).tolist() == [thread, k] for k, array in enumerate(sent))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(send, range(4)))
    for slot, _ in outbox._halves:
        slot.event.wait()


@pytest.mark.parametrize("sends", [False, True])
@pytest.mark.parametrize("count", [0, 1, 128, 129])
def test_numbers_of_pythons_are_rounded_to_single_precision(monkeypatch, count, sends):
    from spacesim.backend import upload

    if sends:
        monkeypatch.setattr(upload, "select", lambda: "cuda")
    values = np.random.default_rng(count).normal(size=count)
    values[3:4] = 1e300  # infinite
    found = upload.upload_numbers(values.tolist())
    assert type(found) is backend.ad.Float
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(np.array(found), values.astype(np.float32))


def test_numbers_go_by_dr_jit_where_its_library_lacks_the_functions(monkeypatch):
    from spacesim.backend import upload

    monkeypatch.setattr(upload, "select", lambda: "cuda")
    monkeypatch.setattr(upload, "copy_functions", lambda: None)
    monkeypatch.setattr(upload._outbox, "send", None)
    assert np.array(upload.upload_numbers([2.0, 3.0])).tolist() == [2.0, 3.0]


@pytest.mark.gpu
def test_a_number_is_read_before_later_work_ends():
    if backend.select() != "cuda":
        pytest.skip("needs a CUDA device")
    import drjit as dr
    from drjit.cuda import Event

    from spacesim.backend.readback import AsyncNumber

    def launch(sines: int) -> None:
        values = dr.arange(backend.ad.Float, 2**24) + dr.opaque(backend.ad.Float, 0)
        for _ in range(sines):
            values = dr.sin(values)
        dr.eval(values)

    launch(3000)  # compiled
    dr.sync_thread()
    squares = dr.square(dr.arange(backend.ad.UInt64, 31))
    dr.eval(squares)
    number, end = AsyncNumber(squares), Event(enable_timing=False)
    for _ in range(4):
        launch(3000)
    end.record()
    assert number.wait() == 900
    assert not end.query()
    end.wait()
