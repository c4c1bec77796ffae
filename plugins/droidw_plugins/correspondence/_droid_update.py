"""The update operator of the DROID network: ConvGRU, heads and graph aggregation (REFERENCE 1.4).

The arithmetic is the published one, its order is not: convolutions that read the same input are
done at once, and what depends on the source frame alone is done once for all of its edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["Still", "Update", "UpdateOperator"]

_NET = slice(0, 128)
_INP = slice(128, 256)
_CORR = slice(256, 384)
_FLOW = slice(384, 448)


@dataclass(frozen=True)
class Update:
    """What one round gives for E edges.

    Attributes:
        net: [E,128,h,w] new hidden state.
        delta: [E,h,w,2] float32, correction of the position, cells, x then y.
        weight: [E,h,w,2] float32 in (0,1).
        gathered: [E,128,h,w], what aggregation averages over the edges of a source; or None.
    """

    net: Tensor
    delta: Tensor
    weight: Tensor
    gathered: Tensor | None


@dataclass(frozen=True)
class Still:
    """What the motion filter asks again and again of one reference frame.

    Attributes:
        net: [1,128,h,w] hidden state. zr: [1,256,h,w], q: [1,128,h,w] sums before the activation,
        of everything that does not depend on the other frame.
    """

    net: Tensor
    zr: Tensor
    q: Tensor


@dataclass(frozen=True)
class _Fused:
    """Weights of the gates z and r and of the candidate q, by what they read, put together once.

    Attributes:
        zr, q: of hidden state, correlation and flow. zrq_inp, zrq_corr: of all three.
        zr_still, q_flow, q_net: without correlation, for the motion filter.
        everywhere: weight and bias of the global context, the biases of the gates in it.
        heads: weight and bias of `delta`, `weight` and aggregation.
    """

    zr: Tensor
    q: Tensor
    zrq_inp: Tensor
    zrq_corr: Tensor
    zr_still: Tensor
    q_flow: Tensor
    q_net: Tensor
    everywhere: tuple[Tensor, Tensor]
    heads: tuple[Tensor, Tensor]


class _GRU(nn.Module):
    """Parameters of the ConvGRU with global context; `UpdateOperator` computes with them."""

    def __init__(self) -> None:
        super().__init__()
        self.convz = nn.Conv2d(448, 128, 3, padding=1)
        self.convr = nn.Conv2d(448, 128, 3, padding=1)
        self.convq = nn.Conv2d(448, 128, 3, padding=1)
        self.w = nn.Conv2d(128, 128, 1)
        self.convz_glo = nn.Conv2d(128, 128, 1)
        self.convr_glo = nn.Conv2d(128, 128, 1)
        self.convq_glo = nn.Conv2d(128, 128, 1)

    def zr(self, *inputs: slice) -> Tensor:
        """Weights [256,...,3,3] of both gates for these inputs."""
        return torch.cat([_columns(c.weight, inputs) for c in (self.convz, self.convr)])

    def q(self, *inputs: slice) -> Tensor:
        """Weights [128,...,3,3] of the candidate for these inputs."""
        return _columns(self.convq.weight, inputs)


class _Aggregation(nn.Module):
    """Maps of a source frame out of the hidden states of its edges (REFERENCE 1.5)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(128, 128, 3, padding=1)
        self.conv2 = nn.Conv2d(128, 128, 3, padding=1)
        self.eta = nn.Sequential(nn.Conv2d(128, 1, 3, padding=1))
        self.upmask = nn.Sequential(nn.Conv2d(128, 576, 1))


class UpdateOperator(nn.Module):
    """Names as in the published file; `GradientClip` of training is left out."""

    def __init__(self) -> None:
        super().__init__()
        self.corr_encoder = nn.Sequential(
            nn.Conv2d(196, 128, 1), nn.ReLU(True), nn.Conv2d(128, 128, 3, padding=1), nn.ReLU(True)
        )
        self.flow_encoder = nn.Sequential(
            nn.Conv2d(4, 128, 7, padding=3),
            nn.ReLU(True),
            nn.Conv2d(128, 64, 3, padding=1),
            nn.ReLU(True),
        )
        self.weight = _head()
        self.delta = _head()
        self.gru = _GRU()
        self.agg = _Aggregation()
        self._fused: _Fused | None = None

    def fuse(self) -> None:
        """Put weights together that work together; to be called whenever they have changed."""
        gru = self.gru
        weight, bias = _together(gru.convz_glo, gru.convr_glo, gru.convq_glo)
        _, own = _together(gru.convz, gru.convr, gru.convq)
        self._fused = _Fused(
            zr=_last(gru.zr(_NET, _CORR, _FLOW)),
            q=_last(gru.q(_NET, _CORR, _FLOW)),
            zrq_inp=_last(torch.cat([gru.zr(_INP), gru.q(_INP)])),
            zrq_corr=_last(torch.cat([gru.zr(_CORR), gru.q(_CORR)])),
            zr_still=_last(gru.zr(_NET, _FLOW)),
            q_flow=_last(gru.q(_FLOW)),
            q_net=_last(gru.q(_NET)),
            everywhere=(weight.flatten(1), bias + own),
            heads=_together(self.delta[0], self.weight[0], self.agg.conv1),
        )

    @property
    def fused(self) -> _Fused:
        """The weights put together by `fuse`."""
        if self._fused is None:
            self.fuse()
        assert self._fused is not None
        return self._fused

    def forward(
        self,
        net: Tensor,
        inp: Tensor,
        corr: Tensor,
        motion: Tensor | None = None,
        which: Tensor | None = None,
        aggregate: bool = True,
    ) -> Update:
        """One round.

        Args:
            net: [E,128,h,w] hidden state.
            inp: [U,128,h,w] context of the source frames.
            corr: [E,196,h,w] looked-up correlation.
            motion: [E,4,h,w] clamped motion features; None: zeros.
            which: [E] int64, row of `inp` of each edge; None: row e (U = E).
            aggregate: whether `gathered` is wanted.
        """
        if motion is None:
            motion = corr.new_zeros(corr.shape[0], 4, *corr.shape[2:])
        fused = self.fused
        add = F.conv2d(inp, fused.zrq_inp, padding=1)
        add = add.clone() if which is None else add[which]
        add += self._everywhere(net)
        # One buffer for both convolutions, and sums in place: large temporaries are dear.
        x = torch.cat([net, self.corr_encoder(corr), self.flow_encoder(motion)], dim=1)
        zr = F.conv2d(x, fused.zr, padding=1).add_(add[:, :256]).sigmoid_()
        x[:, :128] *= zr[:, 128:]
        q = F.conv2d(x, fused.q, padding=1).add_(add[:, 256:]).tanh_()
        net = torch.lerp(net, q.to(net.dtype), zr[:, :128].to(net.dtype))
        return self._heads(net, aggregate)

    def still(self, net: Tensor, inp: Tensor) -> Still:
        """The part of a round without motion features that depends on the reference alone."""
        flow = self.flow_encoder(net.new_zeros(1, 4, *net.shape[2:]))
        add = F.conv2d(inp, self.fused.zrq_inp, padding=1) + self._everywhere(net)
        zr = F.conv2d(torch.cat([net, flow], 1), self.fused.zr_still, padding=1)
        q = F.conv2d(flow, self.fused.q_flow, padding=1)
        return Still(net, zr + add[:, :256], q + add[:, 256:])

    def drift(self, still: Still, corr: Tensor) -> Tensor:
        """`delta` [h,w,2] of a round without motion features, float32."""
        seen = self.corr_encoder(corr)
        zrq = F.conv2d(seen, self.fused.zrq_corr, padding=1)
        z, r = torch.sigmoid(zrq[:, :256] + still.zr).chunk(2, dim=1)
        q = zrq[:, 256:] + still.q + F.conv2d(r * still.net, self.fused.q_net, padding=1)
        net = torch.lerp(still.net, torch.tanh(q).to(still.net.dtype), z.to(still.net.dtype))
        return _cells(self.delta(net))[0]

    def damping(self, features: Tensor) -> Tensor:
        """`eta` [U,h,w] float32 out of `features`."""
        eta = self.agg.eta(features)[:, 0]
        return 0.01 * F.softplus(eta.float())

    def features(self, mean: Tensor) -> Tensor:
        """[U,128,h,w] out of the mean over the edges of a source of `gathered`, same shape."""
        return F.relu(self.agg.conv2(mean))

    def upmask(self, features: Tensor) -> Tensor:
        """Convex upsampling mask [U,576,h,w] out of `features`, before the softmax."""
        mask: Tensor = self.agg.upmask(features)
        return mask

    def _everywhere(self, net: Tensor) -> Tensor:
        """Share of the global context and all biases in z, r and q, [E,384,1,1]."""
        g = (torch.sigmoid(self.gru.w(net)) * net).mean(dim=(2, 3))
        return F.linear(g, *self.fused.everywhere)[:, :, None, None]

    def _heads(self, net: Tensor, aggregate: bool) -> Update:
        """All 3x3 convolutions of the new hidden state at once."""
        weight, bias = self.fused.heads
        if not aggregate:
            weight, bias = weight[:256], bias[:256]
        hidden = F.relu(F.conv2d(net, weight, bias, padding=1), inplace=True)
        delta = _cells(self.delta[2](hidden[:, :128]))
        sure = torch.sigmoid(_cells(self.weight[2](hidden[:, 128:256])))
        return Update(net, delta, sure, hidden[:, 256:] if aggregate else None)


def _head() -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(128, 128, 3, padding=1), nn.ReLU(True), nn.Conv2d(128, 2, 3, padding=1)
    )


def _together(*layers: nn.Module) -> tuple[Tensor, Tensor]:
    """Weight and bias of one convolution that does the work of several."""
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv2d)]
    biases = [c.bias for c in convolutions if c.bias is not None]
    return torch.cat([c.weight for c in convolutions]), torch.cat(biases)


def _columns(weight: Tensor, inputs: tuple[slice, ...]) -> Tensor:
    return torch.cat([weight[:, part] for part in inputs], dim=1)


def _last(weight: Tensor) -> Tensor:
    return weight.contiguous(memory_format=torch.channels_last)


def _cells(maps: Tensor) -> Tensor:
    """[E,2,h,w] in any precision as [E,h,w,2] float32."""
    return maps.permute(0, 2, 3, 1).float().contiguous()
