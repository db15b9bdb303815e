#!/usr/bin/env bash
# The one place where PCW is set up. `demo`, `test` and `run` beside this file use it; so may you (bash):
#
#   ./pcw_bringup_scripts/setup_env.sh [--test]         install what is missing, build what has changed
#   source pcw_bringup_scripts/setup_env.sh [--test]    the same, and the environment in this shell
#
# Where ROS 2 Jazzy is installed it is used, and only what it and the system lack goes into a virtual environment on top of them.
# Where not, ROS comes from hashed wheels into the virtual environment. Either way .venv/ and .colcon/ in the repository are all
# that is written; removing both undoes everything. --test adds what only the tests need.
#
# PCW_PYTHON      the Python to use, 3.11 or 3.12          (default: the system's with ROS, else the first that fits)
# PCW_ROS_SETUP   setup file of a ROS 2 Jazzy installation (default: /opt/ros/jazzy/setup.bash; PCW_ROS_SETUP=none: wheels)
#
# Kept as they are when you have set them: ROS_AUTOMATIC_DISCOVERY_RANGE, RMW_IMPLEMENTATION, FASTRTPS_DEFAULT_PROFILES_FILE.

# ------------------------------------------------------------------------------------------------------------- environment

# Another ROS in this shell, a workspace of one, or another environment with ROS wheels would be mixed with ours.
_pcw_leave_other_ros() {
  local variable entry prefix keep entries prefixes
  IFS=: read -r -a prefixes <<< "${AMENT_PREFIX_PATH:-}:/opt/ros"
  for variable in PYTHONPATH LD_LIBRARY_PATH; do
    keep=""
    IFS=: read -r -a entries <<< "${!variable:-}"
    for entry in "${entries[@]}"; do
      for prefix in "${prefixes[@]}"; do
        if [[ -n "$prefix" && "$entry" == "$prefix"/* ]]; then continue 2; fi
      done
      if [[ -n "$entry" && "$entry" != */site-packages/ros_*.libs ]]; then keep+="${keep:+:}$entry"; fi
    done
    if [[ -n "$keep" ]]; then export "$variable=$keep"; else unset "$variable"; fi
  done
  unset PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH ROS_DISTRO _ROS_WHEELS_BOOTSTRAP_COMPLETE
}

# In the caller's shell: whatever it does must leave the options of that shell as they were.
_pcw_activate() {
  local scripts root ros_setup flags="$-"
  scripts="$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")" && pwd -P)"
  root="$(dirname -- "$scripts")"
  ros_setup="${PCW_ROS_SETUP:-/opt/ros/jazzy/setup.bash}"
  set +eu
  if [[ -f "$ros_setup" ]]; then
    # shellcheck disable=SC1090
    source "$ros_setup"
  else
    _pcw_leave_other_ros
  fi
  export VIRTUAL_ENV="$root/.venv"
  case "$PATH:" in "$VIRTUAL_ENV/bin:"*) ;; *) export PATH="$VIRTUAL_ENV/bin:$PATH" ;; esac
  # shellcheck disable=SC1091
  source "$root/.colcon/install/local_setup.bash"
  # Nodes of one robot on one machine: no multicast leaves it, and they find each other at once. Set these to reach further.
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
  export RMW_IMPLEMENTATION="${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}"
  export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$scripts/config/fastdds_local.xml}"
  [[ $flags == *e* ]] && set -e
  [[ $flags == *u* ]] && set -u
  return 0
}

# Sourced: the set-up runs in a process of its own, so that a failure cannot close an interactive shell and no helper stays behind.
if [[ "${BASH_SOURCE[0]}" != "$0" ]]; then
  if bash "${BASH_SOURCE[0]}" "$@" && _pcw_activate; then
    unset -f _pcw_activate _pcw_leave_other_ros
    return 0
  fi
  unset -f _pcw_activate _pcw_leave_other_ros
  return 1
fi

# ---------------------------------------------------------------------------------------------------------- set-up process

_pcw_setup() {
  set -euo pipefail
  umask 022
  scripts="$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")" && pwd -P)"
  root="$(dirname -- "$scripts")"
  requirements="$scripts/requirements"
  venv="$root/.venv"
  state="$venv/.pcw"
  colcon="$root/.colcon"
  log="$colcon/log/setup.log"
  packages=(pcw_description pcw_estimation pcw_control pcw_terrain pcw_sim_bridge pcw_bringup_scripts)
  ros_setup="${PCW_ROS_SETUP:-/opt/ros/jazzy/setup.bash}"
  with_test=0
  while (($#)); do
    case "$1" in
      --test) with_test=1 ;;
      --runtime) with_test=0 ;; # the default; a script that sources this file names it, or bash would hand over its arguments
      -h | --help) sed -n '2,/^$/s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 0 ;;
      *) fail "Unknown argument: $1" "Allowed: --runtime, --test, --help." ;;
    esac
    shift
  done
  # Both end in the first line of every executable or in PYTHONPATH, where they would cut the path in two.
  [[ "$root" != *[[:space:]:]* ]] || fail "There is a space or a colon in the path of this clone: $root" "Clone into another folder."
  mkdir -p "$colcon/log" || fail "Cannot write into $root." "Clone into a folder that you may write to."
  touch "$colcon/COLCON_IGNORE"
  started="$(now)"
  heartbeat=""
  trap stop_heartbeat EXIT
  trap 'exit 130' INT
  trap 'exit 143' TERM
  lock
  : > "$log"
  if [[ -f "$ros_setup" ]]; then mode=ros; else mode=wheels; fi
  enter_mode
  check_python_wish
  install_requirements
  build_packages
  say "ready in $(elapsed "$started") s ($mode mode, Python $(cat "$state/version"))"
}

say() { printf '[pcw] %s\n' "$*" >&2; }

fail() {
  printf '\n[pcw] ERROR: %s\n' "$1" >&2
  [[ -n "${2:-}" ]] && printf '[pcw] Remedy: %s\n' "$2" >&2
  exit 1
}

now() { local t="${EPOCHREALTIME:-$SECONDS.000000}"; printf '%s' "${t/[.,]/}"; }

elapsed() { local t=$((($(now) - $1) / 100000)); printf '%d.%d' $((t / 10)) $((t % 10)); }

# step LABEL COMMAND...: run the command with its output in the log, say that it still runs, say how long it took.
step() {
  local label="$1" since code=0
  shift
  since="$(now)"
  say "$label ..."
  printf '\n### %s: %s\n' "$label" "$*" >> "$log"
  (while sleep 10 2> /dev/null && kill -0 $$; do say "  ... $(elapsed "$since") s"; done) 9>&- < /dev/null > /dev/null &
  heartbeat=$!
  "$@" >> "$log" 2>&1 9>&- < /dev/null || code=$?
  stop_heartbeat
  if ((code)); then say "$label: FAILED after $(elapsed "$since") s"; else say "$label: $(elapsed "$since") s"; fi
  return "$code"
}

stop_heartbeat() {
  [[ -n "$heartbeat" ]] || return 0
  kill "$heartbeat" 2> /dev/null || true
  wait "$heartbeat" 2> /dev/null || true
  heartbeat=""
}

# Two set-ups at a time would tread on each other; the second waits and then finds everything done.
lock() {
  command -v flock > /dev/null || return 0
  exec 9> "$colcon/lock"
  flock --nonblock 9 && return 0
  say "another set-up of this clone is running; waiting for it"
  flock --timeout 1800 9 || fail "Another set-up has held $colcon/lock for 30 minutes." "End that process and try again."
}

enter_mode() {
  if [[ $mode == ros ]]; then
    source_quietly "$ros_setup"
    [[ "${ROS_DISTRO:-}" == jazzy ]] || fail "$ros_setup is ROS '${ROS_DISTRO:-?}', not jazzy." \
      "Point PCW_ROS_SETUP to the setup.bash of ROS 2 Jazzy, or set PCW_ROS_SETUP=none to use wheels."
  else
    _pcw_leave_other_ros
  fi
}

source_quietly() {
  set +u
  # shellcheck disable=SC1090
  source "$1"
  set -u
}

# ------------------------------------------------------------------------------------------------------------------ Python

# Print "VERSION EXECUTABLE" if $1 runs and fits; a pyenv shim of a version that is not there does not run.
probe_python() {
  "$1" -I -c '
import sys
if sys.version_info[:2] not in ((3, 11), (3, 12)):
    sys.exit(3)
try:
    import ensurepip, venv
except ImportError:
    sys.exit(4)
print("%d.%d.%d" % sys.version_info[:3], sys.executable)' 2> /dev/null < /dev/null
}

check_python_wish() {
  wish="${PCW_PYTHON:-}"
  [[ -n "$wish" ]] || return 0
  local code=0
  found="$(probe_python "$wish")" || code=$?
  case "$code" in
    0) return 0 ;;
    3) fail "PCW_PYTHON=$wish is neither Python 3.11 nor 3.12." "Set PCW_PYTHON to a Python 3.11 or 3.12, or unset it." ;;
    4) fail "PCW_PYTHON=$wish cannot make virtual environments." "Install its venv module (Debian, Ubuntu: apt install python3-venv)." ;;
    *) fail "PCW_PYTHON=$wish does not run." "Set PCW_PYTHON to a Python 3.11 or 3.12, or unset it." ;;
  esac
}

find_python() {
  local candidates candidate code lacks_venv=""
  if [[ -n "$wish" ]]; then
    candidates=("$wish")
  elif [[ $mode == ros ]]; then
    candidates=(/usr/bin/python3 python3) # the one that ROS was compiled for
  else
    candidates=(python3.11 python3.12 python3 python) # 3.11 first: there is no pybullet wheel for 3.12
  fi
  for candidate in "${candidates[@]}"; do
    code=0
    found="$(probe_python "$candidate")" || code=$?
    if ((code == 4)); then lacks_venv="$candidate"; fi
    ((code == 0)) || continue
    python="${found#* }"
    version="${found%% *}"
    if [[ $mode == ros ]] && ! "$python" -c 'import rclpy' >> "$log" 2>&1; then continue; fi
    return 0
  done
  if [[ -n "$lacks_venv" ]]; then
    fail "$lacks_venv cannot make virtual environments (no venv or ensurepip module)." \
      "Debian, Ubuntu: sudo apt install python3-venv"
  elif [[ $mode == ros ]]; then
    fail "No Python that imports rclpy after sourcing $ros_setup (tried: ${candidates[*]})." \
      "sudo apt install ros-jazzy-rclpy, or set PCW_ROS_SETUP=none to use wheels instead."
  fi
  fail "No Python 3.11 or 3.12 found (tried: ${candidates[*]})." \
    "Install one (Debian 12: apt install python3 python3-venv; Ubuntu 24.04: apt install python3 python3-venv; elsewhere: pyenv \
install 3.11), or name it: PCW_PYTHON=/path/to/python3.11"
}

# ------------------------------------------------------------------------------------------------------------ requirements

hash_files() { cat -- "$@" | sha256sum | cut -c1-16; }

runtime_key() { echo "1 $root $mode $(hash_files "$requirements"/{bootstrap,runtime}.txt)"; }

test_key() { echo "1 $(hash_files "$requirements/test.txt")"; }

# Whether the environment stands whole: the marker of an unfinished installation is absent, the stamp (written last) fits.
venv_fits() {
  [[ -x "$venv/bin/python" && ! -e "$state/unfinished" && -f "$state/runtime" ]] || return 1
  [[ "$(cat "$state/runtime")" == "$(runtime_key)" ]] || return 1
  [[ -z "$wish" || "${found#* }" == "$(cat "$state/python")" ]] || return 1
  [[ ! -f "$state/test" || "$(cat "$state/test")" == "$(test_key)" ]] || return 1
  "$venv/bin/python" -I -S -c '' 2> /dev/null
}

install_requirements() {
  if ! venv_fits; then make_venv; fi
  if ((with_test)) && [[ ! -f "$state/test" ]]; then
    touch "$state/unfinished"
    install_lock "what the tests need" test.txt
    check_imports hypothesis mypy pytest
    test_key > "$state/test"
    rm "$state/unfinished"
  fi
}

make_venv() {
  if [[ -e "$venv" ]]; then say "the environment in .venv is unfinished or out of date: making it anew"; fi
  find_python
  check_disk
  say "ROS: $([[ $mode == ros ]] && echo "$ros_setup" || echo "wheels (no $ros_setup)"); Python $version: $python"
  rm -rf -- "$venv"
  local options=()
  if [[ $mode == ros ]]; then options=(--system-site-packages); fi
  step "making a virtual environment in .venv" "$python" -m venv "${options[@]}" "$venv" ||
    explain_failure "The virtual environment could not be made."
  mkdir -p "$state"
  touch "$state/unfinished" "$venv/COLCON_IGNORE"
  step "installing the installer (uv)" pip_install "$requirements/bootstrap.txt" || explain_failure "uv could not be installed."
  install_lock "what the packages need" runtime.txt
  local modules=(rclpy numpy scipy numba yaml jinja2 matplotlib pybullet mcap rosbags colcon_core)
  check_imports "${modules[@]}"
  echo "$python" > "$state/python"
  echo "$version" > "$state/version"
  runtime_key > "$state/runtime"
  rm "$state/unfinished"
}

check_disk() {
  local free
  free="$(df -Pk "$root" | awk 'NR == 2 {print $4}')"
  ((free > 3000000)) || fail "Only $((free / 1000)) MB free for $root; the set-up takes up to 3 GB." "Free some disk space."
}

pip_install() {
  PIP_USER=0 "$venv/bin/python" -m pip install --disable-pip-version-check --no-input --require-hashes "${@:2}" -r "$1"
}

uv_install() {
  "$venv/bin/uv" pip install --python "$venv/bin/python" --require-hashes --compile-bytecode "${@:2}" -r "$1"
}

# install_lock WHAT LOCK: with ROS, only those entries of the lock that neither the system nor the environment has.
install_lock() {
  local file="$requirements/$2" options=() entries
  if [[ $mode == ros ]]; then
    file="$state/missing-$2"
    "$venv/bin/python" "$requirements/select_missing.py" "$requirements/$2" > "$file"
    options=(--no-deps)
  fi
  entries="$(grep -c '==' "$file" || true)"
  ((entries)) || return 0
  warn_of_compiling "$file"
  step "installing $1 ($entries pinned packages)" uv_install "$file" "${options[@]}" && return 0
  # pip may know a mirror or proxy that uv does not.
  if grep -q 'No space left' "$log"; then explain_failure "The requirements could not be installed."; fi
  step "once more with pip" pip_install "$file" "${options[@]}" || explain_failure "The requirements could not be installed."
}

warn_of_compiling() {
  [[ "$("$venv/bin/python" -I -S -c 'import sys; print(sys.version_info[1])')" -ge 12 ]] || return 0
  grep -q '^pybullet==' "$1" || return 0
  compgen -G "$venv/lib/python3*/site-packages/pybullet-*.dist-info" > /dev/null && return 0
  say "pybullet has no wheel for this Python and is compiled from source, once on this machine: four minutes or more on two cores"
  local include
  include="$("$venv/bin/python" -I -c 'import sysconfig; print(sysconfig.get_path("include"))')"
  if ! command -v c++ > /dev/null && ! command -v g++ > /dev/null || [[ ! -f "$include/Python.h" ]]; then
    fail "Compiling pybullet takes a C++ compiler and the headers of Python." \
      "Debian, Ubuntu: sudo apt install g++ python3-dev; or use Python 3.11, for which there is a wheel."
  fi
}

check_imports() {
  local list
  list="$(printf '%s, ' "$@")"
  step "checking that what was installed can be imported" "$venv/bin/python" -c "import ${list%, }" ||
    explain_failure "What was installed cannot be imported."
}

# Show the end of the log and name the likely cause.
explain_failure() {
  local tail_of_log remedy="The whole output is in $log. Nothing needs to be undone: run the command again."
  tail_of_log="$(tail -n 25 "$log")"
  printf '%s\n' "$tail_of_log" >&2
  if grep -qiE 'no space left|disk quota' <<< "$tail_of_log"; then
    remedy="The disk is full. Free some space and run the command again."
  elif grep -qiE 'name resolution|failed to resolve|dns error|getaddrinfo|connection (refused|reset|error)|network is unreachable|failed to (connect|fetch)|error sending request|timed out|could not find a version|no matching distribution' <<< "$tail_of_log"; then
    remedy="The package registry could not be reached. Check the network or the proxy and run the command again."
  elif grep -qiE 'certificate' <<< "$tail_of_log"; then
    remedy="TLS certificates were refused. Behind a proxy, point SSL_CERT_FILE and PIP_CERT to its certificates."
  elif grep -qiE "hashes? (are|mismatch|did not match)|do not match the hashes" <<< "$tail_of_log"; then
    remedy="A download is not what was pinned. Clear the caches (pip cache purge; uv cache clean) and run the command again."
  fi
  fail "$1" "$remedy"
}

# ------------------------------------------------------------------------------------------------------------------- build

# Everything of a package that an installation holds; tests, prose and the scripts beside this file are not.
package_key() {
  (
    cd "$root/$1"
    find . \( -name __pycache__ -o -name '.?*' -o -name '*.egg-info' -o -path ./test -o -path ./tests -o -path ./requirements \) -prune \
      -o -type f ! -name '*.md' ! -name '*.rst' -print0 | LC_ALL=C sort -z | xargs -0 sha256sum
    cat "$state/python" "$state/runtime"
  ) | sha256sum
}

# A package that has changed is removed and built anew, so that no module that was deleted lives on in the installation.
build_packages() {
  local package changed=() keys=()
  for package in "${packages[@]}"; do
    if [[ ! -d "$colcon/build/$package" || ! -f "$colcon/install/$package/.pcw_built" ||
      "$(package_key "$package")" != "$(cat "$colcon/install/$package/.pcw_built")" ]]; then
      changed+=("$package")
    fi
  done
  ((${#changed[@]})) || return 0
  for package in "${changed[@]}"; do
    rm -rf -- "$colcon/build/$package" "$colcon/install/$package"
    keys+=("$(package_key "$package")")
  done
  if ! step "building with colcon: ${changed[*]}" colcon_build "${changed[@]}"; then
    tail -n 40 "$log" >&2
    fail "colcon could not build: ${changed[*]}" "The whole output is in $log."
  fi
  for package in "${!changed[@]}"; do echo "${keys[$package]}" > "$colcon/install/${changed[$package]}/.pcw_built"; done
}

# The scripts that colcon installs start with the Python that runs colcon: the environment's, which has everything.
colcon_build() (
  cd "$root"
  exec env -u PYTHONDONTWRITEBYTECODE "$venv/bin/python" -m colcon --log-base "$colcon/log" build \
    --base-paths "${packages[@]}" --packages-select "$@" \
    --build-base "$colcon/build" --install-base "$colcon/install" --event-handlers desktop_notification-
)

_pcw_setup "$@"
