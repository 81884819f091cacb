#!/usr/bin/env bash
# Trains the shipped terrain encoder, or the encoders for the tables of worlds of one style, from scratch.
#   scripts/train_encoders.sh checkpoint | tables
# Worlds and encoders are kept in out/; run it again to resume an interrupted run.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${1:?checkpoint or tables}
worlds=out/worlds
cameras="--camera 320x240 --camera-rate 4 --lidar-rate 4"
# Two parallel trainings with one thread each are faster than two sequential ones with two threads.
threads="--threads 1"
mkdir -p "$worlds" out/encoders models

run() { scripts/run.sh "$@"; }

if [ "$target" = checkpoint ]; then
  # Images and sweeps of randomised worlds with the simulator's surfaces as targets: first rough country, then also level
  # sites with more walls, and with the late stages of the backbone, then the map alone, last with more sweeps. Walls
  # cover few cells and weigh more.
  shipped() { # name, worlds, steps, options
    local out=out/encoders/$1 count=$2 steps=$3
    shift 3
    [ -f "$out/training.json" ] && return
    run train --worlds "$count" --samples "$worlds/randomised" --out "$out" --steps "$steps" --sensor camera_lidar \
      --relative-bins 40 --no-edges --losses geometric terrain --no-vegetation --geometric 2 --prominence 5 --precision bfloat16 --threads 1 "$@"
  }
  shipped country 200 2200 --world-styles varied --validate-every 550
  shipped sites 256 1400 --start-from out/encoders/country/encoder.safetensors --rate 0.0012 --train-backbone late \
    --seed 2 --validate-every 350
  shipped map 256 1700 --start-from out/encoders/sites/encoder.safetensors --rate 0.0015 --train-backbone map \
    --seed 5 --validate-every 425
  shipped shipped 256 1000 --start-from out/encoders/map/encoder.safetensors --rate 0.0015 --train-backbone map \
    --sensor-shares 0.25 0.4 0.35 --seed 6 --validate-every 500
  for ending in safetensors json; do
    cp "out/encoders/shipped/encoder.$ending" "models/.terrain_encoder.$ending"
    mv "models/.terrain_encoder.$ending" "models/terrain_encoder.$ending"
  done
  ls -l models
  exit 0
fi

# Complete folders of worlds are marked; incomplete ones are recorded again.
worlds() { # name, ground, first seed, count, options
  local folder=$worlds/$1 ground=$2 seed=$3 count=$4
  shift 4
  [ -f "$folder/.complete" ] && return
  rm -rf "$folder"
  run synthesize "$folder" --seed "$seed" --count "$count" --ground "$ground" $cameras --duration 40 "$@"
  touch "$folder/.complete"
}

train() { # name, steps, options
  local out=out/encoders/$1 steps=$2
  shift 2
  [ -f "$out/training.json" ] && return
  run train "$worlds"/{mixed,grass,rigid,yard}/* --held-out $held_out --samples "$worlds/cut" \
    --out "$out" --steps "$steps" --seed 1 $threads "$@"
}

# Runs a command with its output in a log file, which is printed if the command fails.
logged() { # log, command...
  local log=$1
  shift
  "$@" >"$log" 2>&1 || { cat "$log" >&2; return 1; }
}

worlds mixed mixed 50000 20
worlds grass grass 51000 16
worlds rigid rigid 52000 6
# The robot turns on the spot among walls and grass: recordings along a track contain none close ahead.
worlds yard yard 53000 16 --commands spin --duration 16
held_out="$worlds/mixed/50018 $worlds/mixed/50019 $worlds/grass/51015 $worlds/rigid/52005 $worlds/yard/53015"
# Extract samples first, because parallel trainings would both do it.
run train "$worlds"/{mixed,grass,rigid,yard}/* --held-out $held_out --samples "$worlds/cut" --samples-only

worlds test_rigid rigid 60000 8
worlds test_grass grass 61000 8
others() {
  train no_geometric 1200 --losses terrain trajectory --no-edges &&
    train lidar_network 400 --sensor lidar --losses geometric
}
logged out/encoders/others.log others &
other=$!
# Train with the geometric loss only (lift-splat-shoot), then with all losses. Fine-tuning uses a lower learning rate and
# more weight on the geometric loss and on prominent cells; otherwise walls degrade. Longer fine-tuning improves the ground
# under grass but degrades walls; the mean weights of a short and a long fine-tuning are good at both.
train geometric 800 --losses geometric
train lss 400 --losses geometric --start-from out/encoders/geometric/encoder.safetensors
fine_tune() { # name, steps
  train "$1" "$2" --start-from out/encoders/lss/encoder.safetensors --rate 0.0007 --geometric 3 --prominence 8 --seed 2
}
logged out/encoders/short.log fine_tune short 320 &
short=$!
fine_tune long 1200
wait "$short"
run python scripts/average_encoders.py out/encoders/monoforce/encoder.safetensors \
  out/encoders/long/encoder.safetensors=2 out/encoders/short/encoder.safetensors
cp out/encoders/long/robot.yaml out/encoders/monoforce/robot.yaml
wait "$other"
run evaluate --tables --rigid "$worlds/test_rigid" --grass "$worlds/test_grass" --out out/tables --docs docs/training.md \
  --robot out/encoders/monoforce/robot.yaml \
  --monoforce out/encoders/monoforce/encoder.safetensors --lss out/encoders/lss/encoder.safetensors \
  --lidar-network out/encoders/lidar_network/encoder.safetensors \
  --no-geometric out/encoders/no_geometric/encoder.safetensors
run python benchmarks/wall.py --robot out/encoders/monoforce/robot.yaml --json out/tables/wall.json --png docs/wall.png \
  --docs docs/training.md --monoforce out/encoders/monoforce/encoder.safetensors \
  --no-geometric out/encoders/no_geometric/encoder.safetensors --lss out/encoders/lss/encoder.safetensors
