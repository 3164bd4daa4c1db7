#!/bin/bash
# Train each learner with each kind of exploration on each problem, with one seed after the other.
#
#   experiments/exploration/queue.sh FOLDER SEED...
#
# A finished run in FOLDER/PROBLEM/LEARNER/KIND/SEED is not made again. If they are set, $PROBLEMS, $LEARNERS and $KINDS
# name those to train, and $PYTHON is the interpreter.
set -u
folder=$(realpath -m "${1:?give the folder of the runs, then seeds}")
shift
cd "$(dirname "$0")/../.."
export PYTHONPATH=$PWD:$PWD/examples/crossing OMP_NUM_THREADS=1

declare -A problem weight counts options
problem[pinball]="env=pinball high=none eval.layouts=1"
problem[office]="env=office env.tiles=20 high=none eval.layouts=100"
problem[platform]="env=platform high=none total_frames=200000 eval.every=40000 eval.layouts=200"
problem[crossing]="hydra.searchpath=[file://$PWD/examples/crossing/conf] env=crossing high=meta_critic
    high.gamma=0.9 high.hidden_dims=[64] high.lr=3e-3 high.num_members=1 high.epsilon_final=0.02
    high.epsilon_decisions=3000 high.warmup_decisions=200 high.buffer_size=3000 high.batch_size=128
    high.updates_per_decision=0.1 high.tau=0.05 agent.termination=steps agent.option_length=3
    agent.practice=15000 low.gamma=0.9 low.hidden_dims=[64] num_envs=64 total_frames=30000 eval.every=5000
    eval.layouts=200"
# The reward of a bonus of 1.
weight=([pinball]=50 [office]=50 [platform]=0.02 [crossing]=0.01)
# Cells of a unit. Pinball: places at any speed. Office: tiles.
counts=([pinball]="[10,10,0,0]" [office]=1 [platform]=5 [crossing]=1)
# Options as exploration: a learner above chooses which of the problem's own options acts for the next steps.
options=([pinball]=yes [office]=yes [platform]=yes [crossing]="")

run() {  # run PROBLEM LEARNER KIND SEED
    local settings="${problem[$1]} low=$2"
    case $1-$2 in
        office-hppo) settings+=" num_envs=32 total_frames=1500000 eval.every=100000 low.discrete_entropy=0.02 low.gae_lambda=0.95
            low.epochs=4 low.anneal_steps=200000 low.greedy_discrete=most_probable" ;;
        office-pdqn) settings+=" recipe=pinball_pdqn low.reward_scale=0.01" ;;
        crossing-hppo) settings+=" steps_per_batch=16 low.minibatch_size=256 low.critic_hidden_dims=[64]" ;;
        crossing-pdqn) settings+=" steps_per_batch=4 low.warmup_steps=1000 low.batch_size=128 low.updates_per_step=0.1
            low.critic_lr=3e-3 low.actor_tau=0.05 low.critic_tau=0.05 low.epsilon_steps=5000" ;;
    esac
    case $3 in
        counts) settings+=" exploration=counts exploration.weight=${weight[$1]} exploration.resolution=${counts[$1]}" ;;
        novelty) settings+=" exploration=novelty exploration.weight=${weight[$1]}" ;;
        options)
            [ -n "${options[$1]}" ] || return
            settings=${settings/high=none/high=meta_critic}
            settings+=" env.grouping=default agent.termination=steps agent.option_length=4" ;;
        *) settings+=" exploration=$3" ;;
    esac
    read -r -d '' -a words <<< "$settings"
    "${PYTHON:-python}" run.py "${words[@]}" seed="$4" eval.seed="$4" film=false compile_updates=false hydra.mode=RUN \
        hydra.run.dir="$folder/$1/$2/$3/$4" resume=auto
}

for seed in "$@"; do
    for name in ${PROBLEMS:-crossing platform pinball office}; do
        for learner in ${LEARNERS:-hppo pdqn}; do
            for kind in ${KINDS:-none held counts novelty options}; do
                run "$name" "$learner" "$kind" "$seed"
            done
        done
    done
done
