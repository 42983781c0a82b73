#!/bin/sh
# Make .venv with everything pinned in requirements.lock and this project in it. Run it as often
# as you like: where nothing has changed it ends at once. To change the Python, remove .venv first.
#
# Needs Python 3.11 to 3.13 with its venv module; PYTHON=/path/to/python chooses one. Open3D needs
# a few system libraries even to import: they are installed where apt-get may be used without a
# password, else the line to run is printed. Only the 3D view needs them.
set -eu
cd "$(dirname "$0")/.."

stamp=.venv/.groundfuse-setup
wanted="$(cat requirements.lock pyproject.toml tools/setup.sh | sha256sum | cut -c1-64) $(pwd -P)"
if [ -x .venv/bin/python ] && [ "$(cat "$stamp" 2>/dev/null)" = "$wanted" ]; then
  exit 0
fi

say() { printf 'setup: %s\n' "$*" >&2; }

find_python() {
  for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
    if "$candidate" - 2>/dev/null <<'CHECK'; then
import ensurepip, sys, venv
sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
CHECK
      echo "$candidate"
      return
    fi
  done
  say "needs Python 3.11, 3.12 or 3.13 with its venv module, found none" \
    "(${PYTHON:-python3}: $(${PYTHON:-python3} --version 2>&1 | head -1));" \
    "on Debian: apt-get install python3-venv"
  return 1
}

install_libraries() {
  missing=
  known=$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p 2>/dev/null) || return 0
  for pair in libEGL.so.1:libegl1 libGL.so.1:libgl1 libX11.so.6:libx11-6 \
    libusb-1.0.so.0:libusb-1.0-0 libudev.so.1:libudev1 libidn2.so.0:libidn2-0; do
    case $known in *"${pair%%:*} "*) ;; *) missing="$missing ${pair#*:}" ;; esac
  done
  [ -n "$missing" ] || return 0
  if [ "$(id -u)" = 0 ]; then as_root=; elif sudo -n true 2>/dev/null; then as_root=sudo; else as_root=no; fi
  line="apt-get install -y --no-install-recommends$missing"
  if [ "$as_root" != no ] && command -v apt-get >/dev/null; then
    say "installing$missing for Open3D"
    # shellcheck disable=SC2086 # words are meant to split
    if { $as_root apt-get update -qq && DEBIAN_FRONTEND=noninteractive $as_root $line -qq; } >/dev/null; then
      return 0
    fi
  fi
  say "the 3D view (Open3D) needs$missing; everything else works without. On Debian: sudo $line"
}

python=$(find_python)
install_libraries
if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
  "$python" -m venv --clear .venv
fi
# The inner loops become machine code at their first call, which would make the first map wait for
# a minute. It is kept beside the sources.
compile_loops() {
  say "compiling the inner loops, once; a minute"
  scratch=$(mktemp -d)
  .venv/bin/python tools/fuse_team.py --robots A B --out "$scratch" --quiet >"$scratch/said" 2>&1 ||
    say "the sample could not be fused: $(tail -1 "$scratch/said")"
  rm -rf "$scratch"
}

rm -f "$stamp"
say "installing into .venv, once; the 3D view makes it large, this takes some minutes"
.venv/bin/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements.lock
.venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
compile_loops
printf '%s\n' "$wanted" >"$stamp"
say "done"
