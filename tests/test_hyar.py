"""HyAR: the codec, the correction of outdated latents, and learning a problem with a known optimum."""

import pytest
import torch
from conftest import make_config
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_steps import SPECS

from hpamdp import keys
from hpamdp.policies.low_level.hyar import LATENT, HyAR
from hpamdp.specs import PAMDPSpecs

OPTIONS = dict(
    embedding_dim=3, latent_dim=3, codec_hidden_dim=64, hidden_dims=[64, 64], codec_pretrain_updates=300,
    relabelling="mean", buffer_size=20_000, batch_size=64, gamma=0.9, tau=0.02, critic_lr=1e-3, lr_final_fraction=1.0,
    lr_steps=0, epsilon_steps=3000,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> HyAR:
    return HyAR(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


def one_step_rows(learner: HyAR, num: int) -> TensorDict:
    """Act in a one-step problem: only action 1 is rewarded, the more the nearer its parameters are to (s0, -s1)."""
    td = TensorDict({keys.OBSERVATION: torch.rand(num, 4) * 2 - 1}, [num])
    td = learner.policy(td)
    unit = learner.specs.to_unit(td[keys.PARAMETERS])
    state, own = td[keys.OBSERVATION], unit * learner.codec.mask[td[keys.DISCRETE]]
    error = (unit[:, 1] - state[:, 0]).square() + (unit[:, 2] + state[:, 1]).square()
    td["next"] = {
        keys.OBSERVATION: state + own.sum(-1, keepdim=True) * torch.tensor([1.0, 0.5, 0.0, 0.0]),
        keys.REWARD: torch.where(td[keys.DISCRETE] == 1, 1.0 - error, -0.5).unsqueeze(-1),
        keys.TERMINATED: torch.ones(num, 1, dtype=torch.bool),
    }
    return td


def learn(learner: HyAR, num_batches: int, size: int = 200) -> dict[str, float]:
    for _ in range(num_batches):
        scalars = learner.learn(one_step_rows(learner, size), torch.ones(size, dtype=torch.bool))
    return scalars


@pytest.fixture(scope="module", params=["greedy", pytest.param("nearest", marks=pytest.mark.slow)])
def trained(request) -> HyAR:
    torch.manual_seed(0)
    learner = make(discrete=request.param)
    learn(learner, 16)
    return learner


def test_decoding_an_encoded_action_returns_the_action(trained):
    rows = trained.buffer.sample(500)
    codec = trained.codec
    with torch.no_grad():
        mean, _ = codec.encode(rows["state"], rows["discrete"], rows["unit"])
        discrete = codec.nearest_discrete(codec.embeddings[rows["discrete"]])
        unit, _ = codec.decode(rows["state"], discrete, mean)
    assert torch.equal(discrete, rows["discrete"])
    error = ((unit - rows["unit"]) * codec.mask[rows["discrete"]]).abs()
    assert error.mean() < 0.05


def test_the_learner_finds_the_best_action_and_its_parameters(trained):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = one_step_rows(trained, 1000)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.98
    assert rows["next", keys.REWARD].mean() > 0.85, "random actions earn about -0.4, the optimum 1"


def test_latents_that_still_decode_to_their_action_are_kept_and_a_shifted_codec_triggers_correction(trained):
    rows = trained.buffer.sample(1000)
    with torch.no_grad():
        mean, _ = trained.codec.encode(rows["state"], rows["discrete"], rows["unit"])
        rows["latent"] = torch.cat([trained.codec.embeddings[rows["discrete"]], trained.codec.z_to_unit(mean)], -1)
    _, is_corrected = trained.corrected_latent(rows)
    assert is_corrected.float().mean() < 0.1
    shifted = make(discrete="greedy" if trained.actor.proposes_each else "nearest")
    shifted.load_state_dict(trained.state_dict())
    with torch.no_grad():
        shifted.codec.table.copy_(shifted.codec.table.flip(0))
    latent, is_corrected = shifted.corrected_latent(rows)
    moved = rows["discrete"] != 1
    assert is_corrected[moved].all()
    assert torch.equal(shifted.codec.nearest_discrete(latent[:, :3]), rows["discrete"])


def test_a_random_action_is_encoded_when_sampled(trained):
    rows = trained.buffer.sample(1000)
    is_random = rows["latent"].isnan().any(-1)
    latent, is_corrected = trained.corrected_latent(rows)
    assert is_random.any() and is_corrected[is_random].all() and latent.isfinite().all()


@pytest.mark.parametrize("discrete", ["greedy", "nearest"])
def test_the_greedy_policy_takes_the_best_of_the_actors_latent_actions_and_their_variations(discrete):
    torch.manual_seed(0)
    learner = make(discrete=discrete, greedy_samples=40, greedy_noise=0.5)
    td = TensorDict({keys.OBSERVATION: torch.rand(30, 4) * 2 - 1}, [30])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        latent = learner.policy(td.clone())[LATENT]
    own = learner.actor.proposals(learner.actor(td[keys.OBSERVATION]), learner.codec.embeddings)
    with torch.no_grad():
        tried = [own, *((own + each).clamp(-1.0, 1.0) for each in learner.policy.variations)]
        values = torch.stack([learner.critics(td[keys.OBSERVATION], each).amin(0).amax(-1) for each in tried])
        torch.testing.assert_close(
            learner.critics(td[keys.OBSERVATION], latent.unsqueeze(1)).amin(0)[:, 0], values.amax(0)
        )
    assert (values.argmax(0) > 0).float().mean() > 0.6, "an untrained actor is nowhere near the maximum"
    assert torch.equal(learner.policy.variations[:, :3], torch.zeros(40, 3)), "e says which discrete action it is"


def test_the_greedy_form_takes_the_discrete_action_with_the_highest_q():
    class OwnCritics(torch.nn.Module):
        """Values the embedding `favourite` alone, and z by its first entry."""

        favourite = 0

        def forward(self, state, latent):
            is_favourite = (latent[..., :3] - learner.codec.embeddings[self.favourite]).norm(dim=-1) < 1e-6
            return is_favourite.float().unsqueeze(0) + 0.1 * latent[..., 3].unsqueeze(0)

    learner = make()
    learner.policy.critics = learner.target_critics = critics = OwnCritics()
    td = TensorDict({keys.OBSERVATION: torch.randn(50, 4)}, [50])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for critics.favourite in range(3):
            acted = learner.policy(td.clone())
            assert (acted[keys.DISCRETE] == critics.favourite).all()
            torch.testing.assert_close(acted[LATENT][:, :3], learner.codec.embeddings[critics.favourite].expand(50, -1))


def test_the_target_of_the_greedy_form_is_the_maximum_over_discrete_actions():
    learner = make(target_smoothing=0.0)
    rows = TensorDict(next_state=torch.randn(50, 4), reward=torch.zeros(50), discount=torch.ones(50), batch_size=[50])
    z = learner.target_actor.net(rows["next_state"]).tanh().unflatten(-1, (3, 3))
    each = [
        learner.target_critics(
            rows["next_state"], torch.cat([learner.codec.embeddings[k].expand(50, -1), z[:, k]], -1).unsqueeze(1)
        )
        for k in range(3)
    ]
    torch.testing.assert_close(learner.target(rows), torch.cat(each, -1).amin(0).amax(-1))


@pytest.mark.parametrize(
    ("discrete", "search_samples", "is_left"), [("nearest", 0, False), ("nearest", 8, True), ("greedy", 0, True)]
)
def test_the_greedy_form_or_a_search_leaves_a_discrete_action_whose_neighbours_are_worse(
    discrete, search_samples, is_left
):
    # On the line of embeddings the rewards are .5, -1 and 1: the gradient leads back to the first.
    torch.manual_seed(0)
    specs = PAMDPSpecs(1, (), (1, 1, 1), (-1.0,) * 3, (1.0,) * 3)
    learner = make(
        specs, discrete=discrete, embedding_dim=1, latent_dim=1, codec_every=10**9, actor_lr=2e-3, critic_lr=3e-3,
        search_samples=search_samples, search_weight=1.0,
    )  # fmt: skip
    with torch.no_grad():
        learner.codec.table.copy_(torch.tensor([[-0.8], [0.0], [0.8]]).atanh())
        if discrete == "nearest":
            learner.actor.net[-1].weight.zero_()
            learner.actor.net[-1].bias.copy_(torch.tensor([-1.0, 0.0]))
    num = 128
    taken = torch.randint(3, (num,))
    rows = TensorDict(
        state=torch.zeros(num, 1), discrete=taken, unit=torch.zeros(num, 3),
        reward=torch.tensor([0.5, -1.0, 1.0])[taken], next_state=torch.zeros(num, 1), discount=torch.zeros(num),
        latent=torch.full((num, 2), torch.nan), batch_size=[num],
    )  # fmt: skip
    for _ in range(160):
        learner.updates += 1
        learner.update_once(rows)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = learner.policy(TensorDict({keys.OBSERVATION: torch.zeros(1, 1)}, [1]))
    assert acted[keys.DISCRETE].item() == (2 if is_left else 0)


@pytest.mark.parametrize("discrete", ["greedy", "nearest"])
def test_the_search_tries_no_forbidden_action(discrete):
    torch.manual_seed(0)
    learner = make(discrete=discrete, search_samples=8)
    allowed = torch.tensor([True, False, True]).expand(64, -1)
    asked = []
    learner.critics.register_forward_pre_hook(lambda _, inputs: asked.append(inputs[1]))
    state = torch.rand(64, 4) * 2 - 1
    loss, _ = learner.actor_loss(state, allowed)
    gradient = torch.autograd.grad(loss, learner.actor.net[-1].bias)[0]
    if discrete == "greedy":
        assert (gradient.unflatten(0, (3, 3)) != 0.0).any(-1).tolist() == [True, False, True]
    else:
        tried = learner.codec.nearest_discrete(torch.cat(asked, 1)[..., :3].flatten(0, 1))
        assert tried.unique().tolist() == [0, 2]


def test_ddpg_has_one_critic_an_actor_update_each_time_and_no_noise_in_its_targets():
    learner = make(twin=False, target_smoothing=0.5, policy_delay=2, warmup_steps=200, codec_pretrain_updates=1)
    learn(learner, 1)
    assert learner.critics(torch.zeros(5, 4), torch.zeros(5, 1, 6)).shape == (1, 5, 1)
    assert make().critics(torch.zeros(5, 4), torch.zeros(5, 1, 6)).shape == (2, 5, 1)
    before = learner.actor.net[0].weight.clone()
    learner.updates += 1 + learner.updates % 2  # an odd number, at which TD3 leaves the actor as it is
    rows = learner.buffer.sample(64)
    learner.update_once(rows)
    assert not torch.equal(learner.actor.net[0].weight, before)
    rows["discount"] = torch.ones(64)
    assert torch.equal(learner.target(rows), learner.target(rows))


def test_a_latent_is_outdated_by_the_codecs_own_error(trained):
    rows = trained.buffer.sample(1000)
    rows["latent"] = torch.rand(1000, 6) * 2 - 1
    usual = trained.dynamics_error.clone()
    shares = []
    for factor in (0.01, 1.0, 1e6):
        trained.dynamics_error.copy_(usual * factor)
        _, is_corrected = trained.corrected_latent(rows)
        is_own = trained.codec.nearest_discrete(rows["latent"][:, :3]) == rows["discrete"]
        shares.append(is_corrected[is_own].float().mean().item())
    trained.dynamics_error.copy_(usual)
    assert shares[0] > shares[1] > shares[2] == 0.0
    assert 0.0 < usual < 1.0


def test_with_a_tolerance_a_latent_is_outdated_exactly_where_it_decodes_to_other_parameters(trained):
    rows = trained.buffer.sample(1000)
    codec, discrete = trained.codec, rows["discrete"]
    rows["latent"] = torch.cat([codec.embeddings[discrete].detach(), torch.rand(1000, 3) * 2 - 1], -1)

    def decoding_error(latent: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            unit, _ = codec.decode(rows["state"], discrete, codec.z_from_unit(latent[:, 3:]))
        return ((unit - rows["unit"]) * codec.mask[discrete]).abs().amax(-1)

    plain = trained.options
    trained.options = plain.model_copy(update={"parameter_tolerance": 0.2})
    latent, is_corrected = trained.corrected_latent(rows)
    trained.options = plain
    error = decoding_error(rows["latent"])
    assert torch.equal(is_corrected, error > 0.2)
    assert 0.3 < is_corrected[discrete != 2].float().mean() < 1.0, "the third action has no parameter"
    assert (decoding_error(latent) < 0.2).float().mean() > 0.9
    usual = trained.dynamics_error.clone()
    trained.dynamics_error.fill_(1e6)  # any change of the state will do
    _, is_corrected = trained.corrected_latent(rows)
    trained.dynamics_error.copy_(usual)
    assert not is_corrected.any()


def test_relabelling_by_samples_spreads_over_the_latent_space():
    learner = make(relabelling="sample", discrete="nearest")
    rows = TensorDict(
        state=torch.zeros(1000, 4), next_state=torch.zeros(1000, 4), discrete=torch.ones(1000, dtype=torch.long),
        unit=torch.zeros(1000, 3), latent=torch.full((1000, 6), torch.nan), batch_size=[1000],
    )  # fmt: skip
    latent, _ = learner.corrected_latent(rows)
    assert (latent.std(0) > 0.05).all() and (latent.abs() <= 1.0).all()
    learner.options = learner.options.model_copy(update={"relabelling": "mean"})
    latent, _ = learner.corrected_latent(rows)
    assert (latent.std(0) < 1e-6).all()


def test_the_range_of_a_latent_dimension_that_the_codec_does_not_use_is_that_of_its_prior():
    learner = make()
    learn(learner, 1)
    with torch.no_grad():
        for parameter in learner.codec.encoder[-1].parameters():
            parameter.zero_()  # mean 0 and variance 1 for every action
    learner.fit_latent_range()
    assert (learner.codec.z_high > 1.8).all() and (learner.codec.z_low < -1.8).all()


def test_without_a_number_z_has_as_many_dimensions_as_an_action_has_parameters_at_most():
    assert make(latent_dim=None).codec.latent_dim == 2


@pytest.mark.parametrize(
    ("shape", "fractions"),
    [("linear", (1.0, 0.775, 0.1, 0.1)), ("cosine", (1.0, 0.868198, 0.1, 0.1)), ("constant", (1.0, 1.0, 1.0, 1.0))],
)
def test_the_learning_rates_fall_to_their_final_fraction(shape, fractions):
    rates_at_first = {"codec_lr": 2e-3, "actor_lr": 1e-3, "critic_lr": 3e-3}
    learner = make(lr_final_fraction=0.1, lr_steps=1000, lr_schedule=shape, **rates_at_first)
    rates = []
    for frames in (0, 250, 1000, 5000):
        learner.on_progress(frames)
        rates.append([learner.optimizers[name].param_groups[0]["lr"] for name in ("codec", "actor", "critics")])
    assert rates == [pytest.approx([f * 2e-3, f * 1e-3, f * 3e-3]) for f in fractions]


def random_rows(learner: HyAR, num: int, *, is_done: bool = True) -> TensorDict:
    rows = one_step_rows(learner, num)
    rows["next", keys.DONE] = torch.full((num, 1), is_done)
    return rows


def test_multiplied_inputs_act_on_each_other_alone():
    codec = make(codec_inputs="multiplied").codec
    state, discrete = torch.randn(20, 4), torch.randint(3, (20,))
    some, other = torch.randn(20, 3), torch.randn(20, 3)
    assert not torch.equal(codec.decode(state, discrete, some)[1], codec.decode(state, discrete, other)[1])
    with torch.no_grad():
        codec.decoder.inputs[1].weight.zero_()
        codec.decoder.inputs[1].bias.fill_(-1.0)  # after ReLU, 0 for every state and embedding
    torch.testing.assert_close(codec.decode(state, discrete, some)[1], codec.decode(state, discrete, other)[1])


def test_a_bounded_change_is_predicted_by_tanh_in_the_units_of_the_observation():
    torch.manual_seed(0)
    learner = make(predicted_change="bounded", warmup_steps=100, codec_pretrain_updates=1)
    learn(learner, 1)
    assert torch.equal(learner.codec.change_scale, torch.ones(4))
    with torch.no_grad():
        learner.codec.dynamics_head[-1].bias.fill_(9.0)
        change = learner.codec.change(torch.randn(20, 4), torch.randint(3, (20,)), torch.randn(20, 3))
    assert (change <= 1.0).all() and (change > 0.99).all()


def test_the_mean_loss_averages_over_an_actions_own_parameters_and_the_dimensions_of_z():
    learner = make(latent_dim=6)
    rows = TensorDict(
        state=torch.randn(50, 4), next_state=torch.randn(50, 4), unit=torch.rand(50, 3),
        discrete=torch.ones(50, dtype=torch.long), batch_size=[50],
    )  # fmt: skip
    parts = {}
    for form in ("sum", "mean"):
        learner.options = learner.options.model_copy(update={"codec_loss": form, "reconstruction_weight": 2.0})
        torch.manual_seed(0)
        loss, parts[form] = learner.codec_loss(rows)
    weighted = 2.0 * parts["mean"]["reconstruction"] + 1e-4 * parts["mean"]["kl"] + 0.1 * parts["mean"]["dynamics"]
    torch.testing.assert_close(loss, weighted)
    ratios = {name: (parts["sum"][name] / parts["mean"][name]).item() for name in parts["sum"]}
    assert ratios == pytest.approx({"reconstruction": 2.0, "kl": 6.0, "dynamics": 1.0}, rel=1e-4)


def test_the_latest_error_is_that_of_the_transitions_from_which_the_range_of_z_was_estimated():
    torch.manual_seed(0)
    learner = make(correction_error="latest", codec_pretrain_updates=30, updates_per_step=0.01)
    learn(learner, 10)
    latest = learner.dynamics_error.item()
    for _ in range(5):
        learner._update_codec(learner._codec_sample())
    assert learner.dynamics_error.item() == latest, "a single update does not move it"
    with torch.no_grad():
        learner.codec.dynamics_head[-1].bias.fill_(10.0)
    learner.fit_latent_range()
    assert 95.0 < learner.dynamics_error.item() < 110.0


def test_the_codec_is_updated_once_in_so_many_episodes_after_the_first(monkeypatch):
    learner = make(warmup_steps=100, codec_pretrain_updates=1, codec_episodes=10, codec_first_episode=40)
    learn(learner, 1, 100)
    updates = []
    monkeypatch.setattr(learner, "_update_codec", lambda sample: updates.append(len(sample)) or {})
    due = []
    for num, is_done in [(39, True), (50, False), (10, True), (1, True), (35, True)]:
        learner.learn(random_rows(learner, num, is_done=is_done), torch.ones(num, dtype=torch.bool))
        due.append(len(updates))
    assert due == [0, 0, 0, 1, 4], "after 39, 39, 49, 50 and 85 episodes"


def test_with_a_window_the_critics_see_the_newest_steps_alone_and_none_of_the_warm_up():
    torch.manual_seed(0)
    learner = make(critic_window=80, warmup_steps=200, codec_pretrain_updates=1, updates_per_step=0.1, batch_size=60)
    learn(learner, 1)
    assert learner.updates == 0 and len(learner.buffer) == 200
    learn(learner, 1, 50)
    assert learner.updates == 0, "fewer than a batch"
    learn(learner, 1, 50)
    assert learner.updates == 5
    newest = {row.tobytes() for row in learner.buffer[220:300]["state"].numpy()}
    seen = {row.tobytes() for sample in learner.sample_batches(20) for row in sample["state"].numpy()}
    assert seen == newest
    assert len(learner._codec_sample()) == 60
    drawn = {row.tobytes() for _ in range(20) for row in learner._codec_sample()["state"].numpy()}
    assert len(drawn) > 250, "the codec sees all"


def test_with_a_window_a_run_that_resumes_without_its_steps_learns_from_the_new_ones_at_once():
    torch.manual_seed(0)
    settings = dict(critic_window=80, warmup_steps=200, codec_pretrain_updates=1, updates_per_step=0.1, batch_size=60)
    earlier, resumed = make(**settings), make(**settings)
    learn(earlier, 1)
    learn(earlier, 1, 100)
    resumed.load_state_dict(earlier.state_dict())
    learn(resumed, 1, 70)
    assert resumed.updates == earlier.updates + 7


def test_the_noise_falls_with_the_episodes_after_the_warm_up():
    learner = make(
        noise_initial=1.0, noise_episodes=100, parameter_noise=0.1, epsilon_final=0.0, epsilon_steps=0,
        warmup_steps=200, codec_pretrain_updates=1, updates_per_step=1e-3,
    )  # fmt: skip
    noises = []
    for num, is_done in [(200, True), (50, True), (20, False), (50, True), (50, True)]:
        learner.learn(random_rows(learner, num, is_done=is_done), torch.ones(num, dtype=torch.bool))
        noises.append(learner.policy.noise.item())
    assert noises == pytest.approx([1.0, 0.55, 0.55, 0.1, 0.1])
    assert learner.policy.epsilon == 0.0, "no action is random after the warm-up"
    state = torch.zeros(2000, 4)
    with torch.no_grad():
        latent = learner.policy(TensorDict({keys.OBSERVATION: state}, [2000]))[LATENT]
    assert latent[:, 3:].std(0).mean() < 0.2


def test_inverting_gradients_scale_a_latent_actions_gradient_by_the_range_that_is_left():
    torch.manual_seed(0)
    learner = make(discrete="nearest", inverting_gradients=True)
    state = torch.rand(30, 4) * 2 - 1
    raw = learner.actor.raw(state).detach().requires_grad_()
    learner.actor.raw = lambda _: raw
    gradients = []
    for is_inverting in (False, True):
        learner.options = learner.options.model_copy(update={"inverting_gradients": is_inverting})
        gradients.append(torch.autograd.grad(learner.actor_loss(state, None)[0], raw)[0])
    latent = raw.detach().tanh()
    left = torch.where(gradients[0] < 0.0, 1.0 - latent, 1.0 + latent) / 2.0
    torch.testing.assert_close(gradients[1], gradients[0] * left)


def test_the_published_recipe_learns():
    settings = make_config(["low=hyar_published", "high=none", "env=platform"]).low.settings
    short = dict(warmup_steps=200, codec_pretrain_updates=2, updates_per_step=0.02, critic_window=150)
    learner = make(**{**{name: value for name, value in settings.items() if name != "budget"}, **short})
    for _ in range(3):
        learner.learn(random_rows(learner, 200), torch.ones(200, dtype=torch.bool))
    assert learner.updates == 8 and learner.episodes == 400


@pytest.mark.parametrize("change_unit", ["warmup", "stored"])
def test_the_unit_of_the_predicted_change_follows_the_stored_steps_and_the_prediction_stays(change_unit):
    torch.manual_seed(0)
    learner = make(change_unit=change_unit, warmup_steps=200, codec_pretrain_updates=50, updates_per_step=1e-3)
    learn(learner, 1)  # random steps change the first two entries alone
    rows = random_rows(learner, 2000)
    rows["next", keys.OBSERVATION][:, 3] += torch.randn(2000)
    learner.learn(rows, torch.ones(2000, dtype=torch.bool))
    state, discrete, z = torch.rand(50, 4), torch.randint(3, (50,)), torch.randn(50, 3)
    with torch.no_grad():
        before = learner.codec.change(state, discrete, z) * learner.codec.change_scale
        learner.fit_latent_range()
        after = learner.codec.change(state, discrete, z) * learner.codec.change_scale
    torch.testing.assert_close(after, before)
    _, scalars = learner.codec_loss(learner.buffer.sample(2000))
    follows = change_unit == "stored"
    assert (scalars["dynamics"] < 10.0) == follows, "else thousands, beside 1 of the parameters"
    if follows:
        torch.testing.assert_close(learner.dynamics_error, scalars["dynamics"], rtol=0.3, atol=0.0)
