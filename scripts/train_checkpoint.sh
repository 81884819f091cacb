#!/usr/bin/env bash
# Trains the shipped terrain encoder from scratch.
#   scripts/train_checkpoint.sh
# Worlds and encoders are kept in out/; run it again to resume an interrupted run.
set -euo pipefail
cd "$(dirname "$0")/.."
worlds=out/worlds
mkdir -p "$worlds" out/encoders models

# Images and sweeps of randomised worlds with the simulator's surfaces as targets: first rough country, then also level
# sites with more walls, and with the late stages of the backbone, then the map alone, with more sweeps, and last all of
# that in large batches, which is the longest part. Walls cover few cells and weigh more.
shipped() { # name, worlds, steps, options
  local out=out/encoders/$1 count=$2 steps=$3
  shift 3
  [ -f "$out/training.json" ] && return
  scripts/run.sh train --worlds "$count" --samples "$worlds/randomised" --out "$out" --steps "$steps" --sensor camera_lidar \
    --relative-bins 40 --no-edges --losses geometric terrain --no-vegetation --geometric 2 --prominence 5 --precision bfloat16 --threads 1 "$@"
}
shipped country 200 2200 --world-styles varied --validate-every 550
shipped sites 256 1400 --start-from out/encoders/country/encoder.safetensors --rate 0.0012 --train-backbone late \
  --seed 2 --validate-every 350
shipped map 256 1700 --start-from out/encoders/sites/encoder.safetensors --rate 0.0015 --train-backbone map \
  --seed 5 --validate-every 425
shipped sweeps 256 1000 --start-from out/encoders/map/encoder.safetensors --rate 0.0015 --train-backbone map \
  --sensor-shares 0.25 0.4 0.35 --seed 6 --validate-every 500
shipped half 128 960 --batch 64 --start-from out/encoders/sweeps/encoder.safetensors --train-backbone late \
  --sensor-shares 0.5 0.25 0.25 --seed 11 --validate-every 240
shipped shipped 256 1500 --batch 64 --start-from out/encoders/half/encoder.safetensors --train-backbone late \
  --sensor-shares 0.45 0.3 0.25 --seed 12 --validate-every 375
for ending in safetensors json; do
  cp "out/encoders/shipped/encoder.$ending" "models/.terrain_encoder.$ending"
  mv "models/.terrain_encoder.$ending" "models/terrain_encoder.$ending"
done
ls -l models
