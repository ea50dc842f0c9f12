#!/bin/sh
# Makes ./.venv ready: setup.sh base (to run spacesim), test (to test it as well) or docs (to build its documentation).
#
# 1. a Python from 3.10 to 3.13 with venv ($PYTHON, else the first that fits on the path)
# 2. the versions that requirements/lock.txt pins
# 3. libatomic, which Dr.Jit's wheel takes for granted
# 4. a backend for Dr.Jit: a CUDA device, else libLLVM 19 or newer (spacesim/backend/llvm.py says what it looks for)
#
# Debian and Ubuntu keep venv, libatomic and libLLVM in packages of their own; they are installed with apt-get where missing.
set -eu
cd "$(dirname "$0")/.."

WANTED=${1:-base}
LOCK=requirements/lock.txt
BASILISK=bsk==2.12.1 # in an environment of its own: what it needs is not what we need
TORCH_CPU=https://download.pytorch.org/whl/cpu
LLVM_VERSIONS="22 21 20 19"
export PIP_NO_INPUT=1 PIP_DISABLE_PIP_VERSION_CHECK=1

say() { printf 'setup: %s\n' "$*"; }
stop() { printf 'setup: %s\n' "$*" >&2; exit 1; }

fits() { # is command $1 a Python that we run on?
    "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 14))' >/dev/null 2>&1
}

has_venv() { "$1" -c 'import venv, ensurepip' >/dev/null 2>&1; }

find_python() { # prints a Python that fits, one with venv if there is any
    fallback=
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.10 python}; do
        fits "$candidate" || continue
        if has_venv "$candidate"; then
            echo "$candidate"
            return
        fi
        fallback=${fallback:-$candidate}
    done
    echo "$fallback"
}

apt_install() { # installs package $1 where that takes no questions but sudo's; else fails
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" = 0 ]; then
        as_root=env
    elif command -v sudo >/dev/null; then
        [ -t 0 ] && as_root="sudo env" || as_root="sudo -n env"
    else
        return 1
    fi
    apt="$as_root DEBIAN_FRONTEND=noninteractive apt-get -q -y"
    say "installing the package $1 with apt-get"
    $apt install "$1" </dev/null >/dev/null 2>&1 || {
        $apt update </dev/null >/dev/null && $apt install "$1" </dev/null >/dev/null
    }
}

make_venv() {
    if [ -x .venv/bin/python ] && fits .venv/bin/python && .venv/bin/python -c 'import pip' 2>/dev/null; then
        return
    fi
    python=$(find_python)
    [ -n "$python" ] || stop "Python 3.10 to 3.13 is needed, found $("${PYTHON:-python3}" --version 2>/dev/null || echo none);" \
        "install one (Debian, Ubuntu: sudo apt-get install python3 python3-venv) or name it: make PYTHON=/path/to/python3"
    if ! has_venv "$python"; then
        package="$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
        apt_install "$package" && has_venv "$python" ||
            stop "$python lacks the venv module; type: sudo apt-get install $package"
    fi
    say "creating .venv with $("$python" --version)"
    rm -rf .venv
    "$python" -m venv .venv || stop "$python cannot create .venv"
}

install() { # pip install in the versions of the lock
    PYTHONWARNINGS=ignore .venv/bin/python -m pip install -q -c "$LOCK" "$@"
}

backend_ready() { # succeeds, or prints why no backend can run
    .venv/bin/python - 2>/dev/null <<'PYTHON'
from spacesim import backend

library, sentence = backend.find_llvm()
if library is None and backend.available()["cuda"] is not None:
    print(sentence)
    raise SystemExit(1)
PYTHON
}

make_runtime() { # libatomic, which Dr.Jit's wheel takes for granted and a bare Debian lacks
    have_atomic() { .venv/bin/python -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' 2>/dev/null; }
    if [ "$(uname -s)" = Linux ] && ! have_atomic; then
        apt_install libatomic1 && have_atomic ||
            stop "libatomic.so.1 is needed; type: sudo apt-get install libatomic1 (Fedora: sudo dnf install libatomic)"
    fi
}

make_backend() {
    reason=$(backend_ready) && return
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] || stop "$reason; unset it or name another library"
    for version in $LLVM_VERSIONS; do
        apt-cache show "libllvm$version" >/dev/null 2>&1 && break
    done
    apt_install "libllvm$version" || true
    reason=$(backend_ready) && return
    stop "$reason. Where the archive has no such package: older Debian and Ubuntu: https://apt.llvm.org" \
        "(sudo ./llvm.sh 19), Fedora: sudo dnf install llvm-libs, macOS: brew install llvm;" \
        "DRJIT_LIBLLVM_PATH names a library elsewhere"
}

make_venv
say "installing the versions of $LOCK (about a minute)"
install pip setuptools
install --no-build-isolation -e .
make_runtime
make_backend
if [ "$WANTED" = test ]; then
    install --no-build-isolation -e '.[dev]'
    for extra in cluster docs parquet readers serve sfm spice spz video viewer; do
        install --no-build-isolation -e ".[$extra]" 2>/dev/null ||
            say "what the extra '$extra' needs cannot be had here; its tests are skipped"
    done
    { .venv/bin/python -m venv .venv/basilisk && .venv/basilisk/bin/python -m pip install -q "$BASILISK"; } 2>/dev/null ||
        say "$BASILISK cannot be had here; the tests that fly with it are skipped"
    install torch 2>/dev/null || install --retries 1 --extra-index-url "$TORCH_CPU" torch 2>/dev/null ||
        say "torch's CPU build cannot be had here; the tests that need it (LPIPS) are skipped"
fi
if [ "$WANTED" = docs ]; then
    install --no-build-isolation -e '.[docs]'
    install torch 2>/dev/null || install --extra-index-url "$TORCH_CPU" torch # its part of the API is documented, too
fi
say "done"
