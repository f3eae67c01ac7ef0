"""K networks of one shape: both backends against float64 and autograd, and the kernel's promises to its hosts."""

import copy
import os
import pickle
import threading

import pytest
import torch

from deimos.goals.fear import Fear, FearConfig
from deimos.learn.ppo import PPO, PPOConfig
from deimos.nn import mlps
from deimos.nn.adam import Adam
from deimos.nn.losses import Surrogate, ValueLoss
from deimos.nn.mlps import MLPs, gradients
from deimos.nn.networks import Actor, mlp
from deimos.nn.threads import on_threads

# Depths; widths that fill no register, some, and all; few and many inputs and outputs.
SHAPES = [(5, 1), (5, 7, 1), (12, 64, 64, 3), (11, 50, 33, 9, 6), (3, 130, 2), (48, 1100, 256, 128, 12)]
ROWS = [1, 47, 500]  # less than a register, not a multiple of its lanes, more than a block
BACKENDS = ["kernel", "torch"]


def networks(units, count, activation="relu", seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [mlp(units[0], units[1:-1], units[-1], activation, generator) for _ in range(count)]


def build(nets, backend="kernel", **options):
    """``MLPs`` of copies of networks, by a kernel or by torch."""
    built = MLPs(copy.deepcopy(nets), **options)
    assert built._kernel is not None
    if backend == "torch":
        built._kernel = None
    return built


def given(slopes):
    """A loss with given gradients by the outputs."""
    return lambda y, free: ((y * slopes).sum((1, 2), keepdim=True)[:, :, 0], slopes, free)


def exact(nets, x, slopes):
    """Outputs and gradients by autograd in float64, shapes (K, n, outputs) and (K, numbers)."""
    outputs, grads = [], []
    for k, net in enumerate(copy.deepcopy(nets)):
        y = net.double()(x[k if x.dim() == 3 else ...].double())
        found = torch.autograd.grad((y * slopes[k]).sum(), list(net.parameters()))
        grads.append(torch.cat([grad.flatten() for grad in found]))
        outputs.append(y.detach())
    return torch.stack(outputs), torch.stack(grads)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("activation", ["relu", "elu", "tanh"])
@pytest.mark.parametrize("units", SHAPES)
@pytest.mark.parametrize("rows", ROWS)
def test_outputs_and_gradients_are_autograds(backend, activation, units, rows):
    """They are those of float64 up to float32's rounding, for ReLU where no unit is within rounding of its kink."""
    count = 1 if max(units) > 200 else 3
    nets = networks(units, count, activation)
    generator = torch.Generator().manual_seed(rows)
    x, slopes = (torch.randn(count, rows, n, generator=generator) for n in (units[0], units[-1]))
    outputs, grads = exact(nets, x, slopes)
    built = build(nets, backend)
    torch.testing.assert_close(built.forward(x).double(), outputs, rtol=1e-5, atol=2e-6)
    built.gradient(x, given(slopes))
    # A ReLU whose argument is 0 to rounding may fall on the other side: one row in the gradient of one unit.
    near = 1e-2 * grads.abs().max() if activation == "relu" and rows > 1 else 0.0
    error = (built.grad.double() - grads).abs() / grads.abs().amax(1, keepdim=True)
    assert (error > 1e-5).float().mean() < 1e-2
    assert error.max() * grads.abs().max() <= near + 1e-5 * grads.abs().max()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("workspace", [64, 0])
def test_outputs_lie_where_they_are_wanted(backend, workspace):
    """Outputs are written into memory that is given, in parts too; memory of another shape or order is refused."""
    built = build(networks((5, 8, 3), 2, "relu"), backend, workspace=workspace)
    x, out = torch.randn(40, 5, generator=torch.Generator().manual_seed(0)), torch.full((2, 40, 3), torch.nan)
    expected = built.forward(x)
    assert built.forward(x, out=out).data_ptr() == out.data_ptr()
    assert torch.equal(out, expected)
    for wrong in (out[:, :39], out.double(), torch.zeros(2, 3, 40).mT):
        with pytest.raises(ValueError, match=r"out must be contiguous, float32 and of the shape \(2, 40, 3\), got"):
            built.forward(x, out=wrong)


def test_data_of_a_loss_may_lie_anyhow():
    """Rows that do not lie end to end give the kernel the same bits, also beside a loss that torch computes."""
    built, other = build(critics(3)), build(critics(1))
    x, data = torch.randn(500, 9), torch.rand(3, 3, 500)
    sums, expected = built.gradient(x, ValueLoss(data, 0.2)), built.grad.clone()
    apart = torch.rand(500, 3, 3, 2)[..., 0].permute(1, 2, 0).copy_(data)
    assert apart.stride(2) != 1
    found = gradients((built, x, ValueLoss(apart, 0.2)), (other, x, given(torch.ones(1, 500, 1))))
    assert torch.equal(found[0], sums)
    assert torch.equal(built.grad, expected)
    assert other.grad.any()


@pytest.mark.parametrize("units", SHAPES)
@pytest.mark.parametrize("count", [1, 10])
def test_backends_agree(units, count):
    """Outputs, scores, sums of a loss and gradients are the same to rounding, with inputs shared and of their own."""
    if count * max(units) > 2000:
        units = (6, 20, 4)
    nets = networks(units, count, "elu")
    kernel, plain = build(nets), build(nets, "torch")
    own, shared = torch.randn(count, 130, units[0]), torch.randn(130, units[0])
    for x in (own, shared, own[:, 3:4], shared[:0]):
        torch.testing.assert_close(kernel.forward(x), plain.forward(x), rtol=1e-5, atol=2e-6)
    slopes = torch.randn(count, 130, units[-1])
    for x in (own, shared, shared.t().contiguous().t(), torch.randn(count, units[0], 130).mT):
        sums = [nets.gradient(x, given(slopes)) for nets in (kernel, plain)]
        torch.testing.assert_close(*sums, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(kernel.grad, plain.grad, rtol=1e-4, atol=1e-5 * float(plain.grad.abs().max()))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("contexts", "candidates"), [(1, 1), (7, 33), (40, 100), (3, 1000)])
def test_scores_are_outputs(backend, count, contexts, candidates):
    """A score is the output for (context, candidate), whatever the workspace, also of views."""
    nets = networks((9, 64, 32, 2), count, "tanh")
    context, goals = torch.randn(contexts, 6), torch.randn(candidates, contexts, 3).transpose(0, 1)
    x = torch.cat([context.unsqueeze(1).expand(-1, candidates, -1), goals], dim=2).flatten(0, 1)
    expected = torch.stack([net(x) for net in nets]).detach().view(count, contexts, candidates, 2)
    for workspace in (1, 1024):
        found = build(nets, backend, workspace=workspace).score(context, goals)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_a_small_workspace_is_kept_to():
    """Products of torch's take parts of rows whose activations fit, and give the same."""
    nets = networks((6, 64, 1), 2)
    small, large = build(nets, "torch", workspace=1), build(nets, "torch", workspace=64)
    assert len(list(small.parts(5000))) > 1 == len(list(large.parts(5000)))
    x = torch.randn(5000, 6)
    torch.testing.assert_close(small.forward(x), large.forward(x), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("activation", ["relu", "elu", "tanh"])
def test_nan_stays_nan(backend, activation):
    """A NaN in an input or a weight is one in every output that it belongs to, and in no other."""
    nets = networks((4, 16, 16, 2), 2, activation)
    built = build(nets, backend)
    x = torch.randn(60, 4)
    x[7, 2] = torch.nan
    broken = built.forward(x).isnan()
    assert broken[:, 7].all()
    assert broken.sum() == 4
    score = built.score(torch.randn(5, 2), x[:, :2].view(5, 12, 2).index_fill(0, torch.tensor([3]), torch.nan))
    assert torch.equal(score.isnan().all(3), score.isnan().any(3))
    assert score.isnan()[:, 3].all()
    assert score.isnan().sum() == 2 * 12 * 2
    built.parameters[1, 5] = torch.nan
    assert torch.equal(built.forward(x[:5]).isnan().flatten(1).any(1), torch.tensor([False, True]))
    built.gradient(x[:5], given(torch.ones(2, 5, 2)))
    assert torch.equal(built.grad.isnan().any(1), torch.tensor([False, True]))


@pytest.mark.parametrize("activation", ["relu", "elu", "tanh"])
def test_infinities_are_torchs(activation):
    """A unit at plus or minus infinity gives what torch's modules give: ReLU makes 0 of minus infinity, not NaN."""
    nets = networks((3, 4, 1), 1, activation)
    nets[0][0].bias.data[:2] = torch.tensor([torch.inf, -torch.inf])
    x = torch.randn(5, 3)
    for backend in BACKENDS:
        torch.testing.assert_close(build(nets, backend).forward(x)[0], nets[0](x).detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_no_bit(threads):
    """Outputs, scores, losses and gradients have the same bits on one thread and on several, again and again."""
    nets, critics = networks((12, 40, 48, 3), 1, "elu"), networks((12, 40, 1), 7)
    built = []
    for count in (1, threads):
        with on_threads(count):
            built.append((build(nets), build(critics)))
    x, slopes = torch.randn(5000, 12), torch.randn(1, 5000, 3)
    data = ValueLoss(torch.rand(7, 3, 5000) * torch.tensor([1 / 5000, 1.0, 1.0]).unsqueeze(1), 0.2)
    for _ in range(5):
        found = []
        for count, (own, ensemble) in zip((1, threads), built, strict=True):
            sums = gradients((own, x, given(slopes)), (ensemble, x, data))
            with on_threads(count):
                scores = [nets.score(x[:90, :9], x.view(-1, 20, 3)[:90]) for nets in (own, ensemble)]
            found.append([own.forward(x), *sums, own.grad, ensemble.grad, *scores])
        assert all(torch.equal(*pair) for pair in zip(*found, strict=True))
        assert all(tensor.isfinite().all() and tensor.any() for tensor in found[0])
        for own, ensemble in built:
            own.parameters -= 1e-5 * own.grad
            ensemble.parameters -= 1e-3 * ensemble.grad


def test_two_threads_of_the_host_share_the_kernel():
    """What two threads of Python ask for at the same time is what each gets alone."""
    with on_threads(3):
        built = build(networks((12, 64, 64, 3), 1))
    xs = [torch.randn(3000, 12) for _ in range(2)]
    expected = [built.forward(x) for x in xs]
    same = []

    def ask(i):
        same.extend(torch.equal(built.forward(xs[i]), expected[i]) for _ in range(50))

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(same) == 100
    assert all(same)


def test_a_fork_has_threads_of_its_own():
    """After a fork, which threads do not survive, the child computes what its parent does."""
    with on_threads(3):
        built = build(networks((12, 64, 64, 3), 1))
    x = torch.randn(6000, 12)
    expected = built.forward(x)
    child = os.fork()
    if child == 0:
        os._exit(0 if torch.equal(built.forward(x), expected) else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert torch.equal(built.forward(x), expected)


def test_the_hosts_default_dtype_does_not_matter():
    """In a host whose default is float64, networks and their gradients have float32 and the same bits."""

    def results():
        built = MLPs([Actor(5, (16,), 2, "elu", 0.5, torch.Generator().manual_seed(0))])
        x = torch.linspace(-1, 1, 50, dtype=torch.float32).view(10, 5)
        built.gradient(x, lambda y, free: (y.sum().view(1, 1), y, free))
        Adam(built.parameters, built.grad, torch.tensor(1e-2, dtype=torch.float32)).step()
        return built.forward(x), built.grad, built.parameters, built.score(x[:, :3], x.view(10, 1, 5)[..., 3:])

    expected = results()
    built = build(networks((5, 16, 2), 1))
    x = torch.rand(10, 5)
    assert torch.equal(built.forward(x.double()), built.forward(x))
    torch.set_default_dtype(torch.float64)
    try:
        found = results()
    finally:
        torch.set_default_dtype(torch.float32)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == torch.float32
        assert torch.equal(a, b)


@pytest.mark.parametrize("backend", BACKENDS)
def test_modules_are_views(backend):
    """Modules keep their outputs, see what changes in the vector, and change it; so do gradients, free ones too."""
    actor = Actor(5, (9, 8), 2, "relu", 0.5, torch.Generator().manual_seed(0))
    x = torch.randn(20, 5)
    before = actor(x).detach()
    built = MLPs([actor])
    built._kernel = built._kernel if backend == "kernel" else None
    assert torch.equal(actor(x), before)
    assert built.parameters.shape == (1, sum(p.numel() for p in actor.parameters()))
    for change in (actor.mean[0].bias.data.add_, built.parameters.mul_):
        change(1.5)
        torch.testing.assert_close(built.forward(x)[0], actor(x).detach(), rtol=1e-5, atol=1e-6)
    assert torch.equal(built.parameters[:, built.free], actor.std.data.unsqueeze(0))
    built.gradient(x, lambda y, free: (y.sum().view(1, 1), torch.ones_like(y), 3.0 * free))
    torch.testing.assert_close(actor.std.grad, 3.0 * actor.std.data)
    torch.testing.assert_close(actor.mean[-1].bias.grad, torch.full((2,), 20.0))
    assert torch.equal(built.grad[0], torch.cat([p.grad.flatten() for p in actor.parameters()]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_gradient_is_clipped_by_itself(backend):
    """Norms above the limit become the limit, others stay."""
    built = build(networks((5, 16, 1), 3, "tanh"), backend)
    built.gradient(torch.randn(50, 5), given(torch.tensor([1.0, 1e-4, 3.0]).view(3, 1, 1).expand(3, 50, 1)))
    before, norms = built.grad.clone(), built.grad.norm(dim=1)
    assert norms[0] > 1.0 > norms[1]
    built.clip_gradient(1.0)
    torch.testing.assert_close(built.grad.norm(dim=1), norms.clamp(max=1.0))
    torch.testing.assert_close(built.grad / built.grad.norm(dim=1, keepdim=True), before / norms.unsqueeze(1))


def test_what_was_given_is_not_overwritten():
    """Results of earlier calls keep their numbers."""
    built = build(networks((9, 16, 1), 2))
    results = [built.forward(torch.randn(n, 9)) for n in (3, 9)]
    results += [built.score(torch.randn(n, 6), torch.randn(n, 4, 3)) for n in (3, 9)]
    copies = [result.clone() for result in results]
    built.forward(torch.randn(50, 9))
    assert all(torch.equal(kept, copied) for kept, copied in zip(results, copies, strict=True))


def test_begun_without_gradients_it_continues_with_them():
    """What was first asked for in inference mode, as rsl_rl's rollouts are, is asked for outside it later."""
    x, slopes, built = torch.randn(40, 9), torch.randn(1, 40, 1), build(networks((9, 16, 1), 1))
    with torch.inference_mode():
        first = built.forward(x), built.gradient(x, given(slopes)), built.grad.clone()
    built.gradient(x, given(slopes))
    assert torch.equal(built.grad, first[2])
    assert torch.equal(built.forward(x), first[0])


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (torch.zeros(4, 8), r"x must have the shape \(n, 9\) or \(2, n, 9\), got \(4, 8\)"),
        (torch.zeros(3, 4, 9), r"x must have the shape .* got \(3, 4, 9\)"),
        (torch.zeros(9), r"x must have the shape .* got \(9,\)"),
        (torch.zeros(4, 9, device="meta"), "x must be on cpu, got it on meta"),
    ],
)
@pytest.mark.parametrize("backend", BACKENDS)
def test_other_inputs_are_refused(backend, x, message):
    """Inputs of another shape or device raise ``ValueError``, forwards and backwards, before anything is computed."""
    built = build(networks((9, 16, 1), 2), backend)
    with pytest.raises(ValueError, match=message):
        built.forward(x)
    with pytest.raises(ValueError, match=message):
        built.gradient(x, given(torch.zeros(2, 4, 1)))


def critics(count, outputs=1):
    """Networks of 9 inputs."""
    return networks((9, 16, outputs), count)


def actors(count):
    """Policies of two actions."""
    return [Actor(9, (16,), 2, "relu", 0.5) for _ in range(count)]


def wrong(*shape):
    """A loss that gives gradients by the outputs of some shape."""
    return lambda y, free: (y.sum((1, 2)).unsqueeze(1), torch.zeros(shape), free)


@pytest.mark.parametrize(
    ("nets", "loss", "message"),
    [
        (
            critics(3),
            ValueLoss(torch.zeros(1, 3, 40), 0.2),
            r"ValueLoss must have the shape \(3, 3, 40\) .* \(1, 3, 40\)",
        ),
        (critics(1), ValueLoss(torch.zeros(1, 3, 39), 0.2), r"the shape \(1, 3, 40\) on cpu, got \(1, 3, 39\)"),
        (critics(1), ValueLoss(torch.zeros(1, 9, 40), 0.2), r"the shape \(1, 3, 40\) on cpu, got \(1, 9, 40\)"),
        (critics(1), ValueLoss(torch.zeros(1, 3, 40, device="meta"), 0.2), "on cpu, got .* on meta"),
        (critics(1, 2), ValueLoss(torch.zeros(1, 3, 40), 0.2), "ValueLoss needs networks with one output, got 2"),
        (
            actors(1),
            Surrogate(torch.zeros(1, 9, 40), 0.2),
            r"Surrogate must have the shape \(1, 7, 40\) .* \(1, 9, 40\)",
        ),
        (actors(1), Surrogate(torch.zeros(1, 7, 30), 0.2), r"the shape \(1, 7, 40\) on cpu, got \(1, 7, 30\)"),
        (actors(2), Surrogate(torch.zeros(1, 7, 40), 0.2), "Surrogate needs one network .* got 2 with 2 outputs and 2"),
        (critics(1, 2), Surrogate(torch.zeros(1, 7, 40), 0.2), "got 1 with 2 outputs and 0 free parameters"),
        (critics(3, 2), wrong(1, 40, 2), r"gradients by its outputs of shape \(3, 40, 2\) on cpu, got \(1, 40, 2\)"),
        (critics(1, 2), wrong(1, 39, 2), r"outputs of shape \(1, 40, 2\) on cpu, got \(1, 39, 2\)"),
    ],
)
@pytest.mark.parametrize("backend", BACKENDS)
def test_other_losses_are_refused(backend, nets, loss, message):
    """Data, or gradients by outputs, that do not fit networks and rows raise ``ValueError``: the kernel trusts them."""
    built = build(nets, backend)
    with pytest.raises(ValueError, match=message):
        built.gradient(torch.zeros(40, 9), loss)
    assert not built.grad.any()


class Apart(torch.nn.Module):
    """A network whose free parameters lie before and between its layers."""

    def __init__(self):
        super().__init__()
        self.shift = torch.nn.Parameter(torch.ones(1))
        self.first, self.activation = torch.nn.Linear(3, 4), torch.nn.ReLU()
        self.rest = Actor(4, (), 1, "relu", 0.5)


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (
            torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.GELU(), torch.nn.Linear(4, 1)),
            "got Linear, GELU, Linear",
        ),
        (torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 1)), "must be linear layers with biases and"),
        (torch.nn.Linear(3, 1, bias=False), "linear layers with biases and one of relu, elu, tanh between them"),
        (
            torch.nn.Sequential(*mlp(3, (4,), 4, "relu"), torch.nn.Tanh(), torch.nn.Linear(4, 1)),
            "got Linear, ReLU, Lin",
        ),
        (Apart(), "parameters that belong to no layer must follow each other"),
    ],
)
def test_other_networks_are_refused(module, message):
    """Layers that neither backend computes raise ``ValueError``, and so do networks of different shapes."""
    with pytest.raises(ValueError, match=message):
        MLPs([module])
    with pytest.raises(ValueError, match="must all have the same layers"):
        MLPs([mlp(3, (4,), 1, "relu"), mlp(3, (4,), 1, "elu")])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, pickle.dumps])
def test_copies_name_the_way_out(duplicate):
    """What holds networks of which the kernel knows the address is not copied; the message names ``state_dict``."""
    for held in (
        build(critics(1)),
        PPO(PPOConfig(), 4, 3, 2, torch.device("cpu"), 0),
        Fear(FearConfig(), 3, 2, torch.device("cpu"), 0),
    ):
        with pytest.raises(TypeError, match=r"cannot be copied or pickled.*state_dict\(\)"):
            duplicate(held)


@pytest.mark.parametrize("backend", BACKENDS)
def test_scores_check_their_shapes(backend):
    """No decision has no score; contexts and candidates that do not fit raise ``ValueError``."""
    built = build(networks((9, 16, 1), 1), backend)
    assert built.score(torch.zeros(0, 6), torch.zeros(0, 100, 3)).shape == (1, 0, 100, 1)
    for context, candidates in (((4, 6), (2, 100, 3)), ((4, 5), (4, 100, 3)), ((4, 6), (4, 100, 2))):
        with pytest.raises(ValueError, match=r"must have the shapes \(B, [67]\) and \(B, N, [32]\)"):
            built.score(torch.zeros(*context), torch.zeros(*candidates))


def test_without_warp_torch_does_it(monkeypatch):
    """Where Warp is not installed no kernel is looked for."""
    monkeypatch.setattr(mlps, "find_spec", lambda name: None)
    assert MLPs(networks((3, 8, 2), 1))._kernel is None
