"""The written-out gradients, Adam and TD3's formulas against torch's own, slowly and plainly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import linear, relu

from brakeline.learner.learner_config import TD3Config
from brakeline.learner.networks import Adam, Network
from brakeline.learner.replay import Batch
from brakeline.learner.td3 import TD3

SMALL = TD3Config(hidden=(24, 16), batch=32)


def plain(network: Network, index: int, x: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
    """Perceptron `index` of a network whose flat parameters are `parameters`, for x (batch, in)."""
    views = network._views(parameters)
    for depth, (weight, bias) in enumerate(views):
        x = linear(x, weight[index], bias[index, 0])
        x = relu(x) if depth < len(views) - 1 else x
    return x


def random_batch(seed: int, size: int = 32, observation_dim: int = 5, action_dim: int = 2) -> Batch:
    batch, generator = Batch(size, observation_dim, action_dim), np.random.default_rng(seed)
    for array in batch.arrays:
        array[:] = generator.uniform(-1, 1, array.shape)
    batch.arrays[3][:] = generator.choice([0.0, 0.97], (size, 1))
    return batch


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("outputs", [1, 3])
def test_gradients(count, outputs):
    generator = torch.Generator().manual_seed(1)
    network = Network((5, 24, 16, outputs), count, 32)
    network.initialise(generator)
    x = torch.randn(1, 32, 5, generator=generator)
    dz = torch.randn(count, 32, outputs, generator=generator)
    parameters = network.parameters.clone().requires_grad_()
    inputs = x[0].clone().requires_grad_()
    outputs_plain = torch.stack([plain(network, i, inputs, parameters) for i in range(count)])
    (outputs_plain * dz).sum().backward()
    torch.testing.assert_close(network.forward(x), outputs_plain.detach(), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(network.parameter_gradient(dz.clone()), parameters.grad, atol=1e-5, rtol=1e-5)
    network.forward(x)
    gradient = network.input_gradient(dz.clone(), slice(1, 4)).sum(0)
    torch.testing.assert_close(gradient, inputs.grad[:, 1:4], atol=1e-5, rtol=1e-5)


def test_bfloat16_is_close():
    exact, rounded = Network((26, 128, 128, 1), 2, 64), Network((26, 128, 128, 1), 2, 64, "bfloat16")
    exact.initialise(torch.Generator().manual_seed(2))
    rounded.parameters.copy_(exact.parameters)
    x = torch.randn(1, 64, 26, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(exact.forward(x), rounded.forward(x), atol=0.02, rtol=0.02)
    dz = torch.full((2, 64, 1), 1 / 64)
    ours, theirs = rounded.parameter_gradient(dz.clone()), exact.parameter_gradient(dz.clone())
    assert float(torch.nn.functional.cosine_similarity(ours, theirs, dim=0)) > 0.9999


def test_adam():
    generator = torch.Generator().manual_seed(4)
    ours = torch.randn(50, generator=generator)
    theirs = torch.nn.Parameter(ours.clone())
    adam, reference = Adam(ours, 1e-2), torch.optim.Adam([theirs], 1e-2)
    for _ in range(30):
        theirs.grad = torch.randn(50, generator=generator)
        adam.step(theirs.grad)
        reference.step()
        torch.testing.assert_close(ours, theirs.detach(), atol=1e-6, rtol=1e-5)


def plain_td3_update(agent: TD3, batch: Batch, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """y, ∂L_Q/∂critics and ∂L_π/∂actor (with the critics as they are) from the formulas in learner/td3.py."""
    config = agent.config
    s, a, r, d, s2, c, p, m = (torch.from_numpy(array) for array in batch.arrays)
    smoothing = (noise * config.target_noise).clamp(-config.target_noise_clip, config.target_noise_clip)
    target_actor = plain(agent.target_actor, 0, s2, agent.target_actor.parameters)
    x2 = torch.cat([s2, (torch.tanh(target_actor) + smoothing).clamp(-1, 1)], 1)
    values = [plain(agent.target_critics, i, x2, agent.target_critics.parameters) for i in range(2)]
    y = config.reward_scale * (r - agent.cost_weight * c - agent.penalty_factor * p) + d * torch.minimum(*values)

    critics = agent.critics.parameters.clone().requires_grad_()
    x = torch.cat([s, a], 1)
    sum(((plain(agent.critics, i, x, critics) - y) ** 2).mean() for i in range(2)).backward()

    actor = agent.actor.parameters.clone().requires_grad_()
    proposed = torch.tanh(plain(agent.actor, 0, s, actor))
    value = plain(agent.critics, 0, torch.cat([s, proposed], 1), agent.critics.parameters).mean()
    (config.imitation * (m * ((proposed - a) ** 2).sum(1, keepdim=True)).mean() - value).backward()
    return y, critics.grad, actor.grad


@pytest.mark.parametrize("imitation", [0.0, 0.7])
def test_td3_formulas(imitation):
    agent = TD3(5, 2, replace(SMALL, policy_delay=1, imitation=imitation), seed=3)
    agent.cost_weight, agent.penalty_factor = 2.5, 1.5
    for seed in range(5):  # away from where targets and networks are equal
        agent.update(random_batch(seed))
    batch = random_batch(9)
    twin = torch.Generator()
    twin.set_state(agent._generator.get_state())
    noise = torch.empty(1, 32, 2).normal_(generator=twin)[0]
    y, critic_gradient, actor_gradient = plain_td3_update(agent, batch, noise)
    state = agent._generator.get_state()
    torch.testing.assert_close(agent.target(batch)[0], y, atol=1e-6, rtol=1e-5)
    agent._generator.set_state(state)
    agent.critic_adam.rate = 0.0  # so that the actor's gradient is by the critics as they were
    before = agent.target_actor.parameters.clone()
    agent.update(batch)
    torch.testing.assert_close(agent.critics.gradients, critic_gradient, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(agent.actor.gradients, actor_gradient, atol=1e-6, rtol=1e-4)
    expected = before + SMALL.tau * (agent.actor.parameters - before)
    torch.testing.assert_close(agent.target_actor.parameters, expected)


def test_actor_is_delayed():
    agent = TD3(5, 2, SMALL, seed=0)
    start = agent.actor.parameters.clone()
    agent.update(random_batch(0))
    assert torch.equal(agent.actor.parameters, start)
    agent.update(random_batch(1))
    assert not torch.equal(agent.actor.parameters, start)


def test_draws_are_from_no_global_generator():
    global_state = torch.get_rng_state()
    TD3(5, 2, SMALL, seed=9).update(random_batch(0))
    assert torch.equal(torch.get_rng_state(), global_state)


def test_learns_a_bandit_in_bfloat16():
    """Reward −|a − s|² and the episode ends: the best action is the observation."""
    config = TD3Config((64, 64), batch=64, actor_rate=1e-3, critic_rate=1e-3, reward_scale=1.0, precision="bfloat16")
    agent, batch, generator = TD3(2, 2, config, seed=0), Batch(64, 2, 2), np.random.default_rng(0)
    for _ in range(700):
        s, a = generator.uniform(-0.8, 0.8, (64, 2)), generator.uniform(-1, 1, (64, 2))
        for array, value in zip(batch.arrays, (s, a, -((a - s) ** 2).sum(1, keepdims=True), 0.0, s), strict=False):
            array[:] = value
        agent.update(batch)
    action = agent.actor.forward(batch.observation).tanh()
    assert float((action - batch.observation).square().mean()) < 0.02


NAN = float("nan")
WRONG = {"batch": 0, "warmup": 1, "gamma": 1.5, "hidden": (), "tau": 0.0, "cost_limit": 1.0}
NUMBERS = [(name, NAN) for name in ("updates_per_step", "actor_rate", "exploration_noise", "reward_scale", "imitation")]
NUMBERS += [(name, 0.0) for name in ("updates_per_step", "multiplier_rate", "reward_scale")]
NUMBERS += [("imitation", -1.0), ("penalty_growth", 0.5)]
REFUSED = [(f"{name} = {value} is not", value) for name, value in NUMBERS]


@pytest.mark.parametrize(("said", "value"), [*WRONG.items(), ("cost_limit", -0.1), *REFUSED])
def test_configurations_that_cannot_be(said, value):
    with pytest.raises(ValueError, match=f"^[^:]*{said}"):
        TD3Config(**{said.split()[0]: value})
