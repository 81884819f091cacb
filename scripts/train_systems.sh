#!/usr/bin/env bash
# Trains the terrain sources that benchmarks/terrain.py compares, with three training seeds each, and writes the tables.
#   scripts/train_systems.sh [STEPS [SEED]]
# SEED is the first of the reporting seeds; once looked at, they serve no other table.
# Everything is kept in out/systems/; run it again to resume an interrupted run. docs/protocol.md describes it.
set -euo pipefail
cd "$(dirname "$0")/.."
steps=${1:-600}
seed=${2:-440000}
jobs=${JOBS:-2}
out=out/systems
mkdir -p "$out/log"

# Seeds for training and for choosing (benchmarks/terrain.py): 64 and 8 worlds.
training=$(seq 421000 421063)
choosing=$(seq 430600 430607)
record="scripts/run.sh synthesize --style varied --robot husky --camera 320x240 --camera-rate 2 --lidar 32x360 \
  --lidar-rate 4 --duration 30 --quiet --force"
for seed in $training $choosing; do
  [ -f "$out/worlds/$seed.world.json" ] || echo "$seed"
done | xargs -r -P "$jobs" -I SEED $record --seed SEED "$out/worlds/SEED"

bags=$(printf "$out/worlds/%s " $training)
held_out=$(printf "$out/worlds/%s " $choosing)
common="$bags --held-out $held_out --robot husky --samples $out/samples"
# Extract samples first, because parallel trainings would all do it: H_t* fitted, and as the wheels traced it.
fitted="--fit-iterations 40" traced="--fit-iterations 0"
for targets in "$fitted" "$traced"; do
  scripts/run.sh train $common $targets --samples-only --jobs "$jobs" --out "$out/samples"
done

# Same start, samples, steps, augmentation and weights; steps are restored by none of them.
train="scripts/run.sh train $common --steps $steps --relative-bins 40 --no-edges --no-vegetation --precision bfloat16 \
  --threads 1 --validate-every "$steps" --quiet"
geometric="--losses geometric" all="--losses geometric terrain trajectory"
options() { # system
  case $1 in
    lidar_hg) echo "--sensor lidar $geometric $fitted" ;;
    lidar_ht) echo "--sensor lidar $all $fitted" ;;
    lidar_ht_traced) echo "--sensor lidar $all $traced" ;;
    lss) echo "--sensor camera $geometric $fitted" ;;
    monoforce) echo "--sensor camera $all $fitted" ;;
    both) echo "--sensor camera_lidar --all-sensors $all $fitted" ;;
    # Without all that the lidar teaches; without all that the driven ground teaches.
    no_geometric) echo "--sensor camera --losses terrain trajectory --no-depth $fitted" ;;
    no_terrain) echo "--sensor camera --losses geometric trajectory $fitted" ;;
  esac
}
systems="lidar_hg lidar_ht lidar_ht_traced lss monoforce both no_geometric no_terrain"
seeds="1 2 3"
for training_seed in $seeds; do
  for system in $systems; do
    encoder=$out/encoders/$system.$training_seed
    [ -f "$encoder/training.json" ] || echo "$(options "$system") --seed $training_seed --out $encoder"
  done
done | xargs -r -P "$jobs" -I OPTIONS bash -c "$train OPTIONS >>$out/log/training.log 2>&1 || { tail -20 $out/log/training.log >&2; exit 255; }"

checkpoints=""
for system in $systems; do
  for training_seed in $seeds; do
    checkpoints+=" --checkpoint $system=$out/encoders/$system.$training_seed/encoder.safetensors"
  done
done
for system in shipped shipped_lidar shipped_both; do
  checkpoints+=" --checkpoint $system=models/terrain_encoder.safetensors"
done
scripts/run.sh python benchmarks/terrain.py --out "$out/tables" --seed "$seed" --jobs "$jobs" $checkpoints --docs docs/training.md \
  --sheet docs/worst_cases.jpg
scripts/run.sh python benchmarks/wall.py $checkpoints --seed $((seed + 6000)) --json "$out/tables/wall.json" --png docs/wall.png \
  --docs docs/protocol.md
