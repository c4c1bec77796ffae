"""The trained weights of the built-in parts: where they are published, and under what licence.

Importing this loads nothing; a part names its record in `Component.weights`. None of the authors
publishes a checksum: the first fetch records one.
"""

from __future__ import annotations

from droidw.plugin.weights import WeightsFile

__all__ = [
    "DINOV2_VITS14",
    "DINOV2_VITS14_REG",
    "DROID",
    "FIT3D",
    "FIT3D_PLAIN",
    "METRIC3D_VIT_LARGE",
    "METRIC3D_VIT_SMALL",
]

DROID = WeightsFile(
    name="droid",
    urls=("https://drive.google.com/uc?export=download&id=1PpqVt1H4maBa_GbPJp4NwxRsd9jk-elh",),
    size=16_000_000,
    licence="BSD-3-Clause (code); weights: nothing separate stated",
    file="droid.pth",
    check="droidw_plugins.correspondence._droid_state:check_state",
    reference="Teed and Deng, DROID-SLAM, NeurIPS 2021; github.com/princeton-vl/DROID-SLAM",
)

FIT3D = WeightsFile(
    name="fit3d",
    urls=("https://huggingface.co/yuanwenyue/FiT3D/resolve/main/dinov2_reg_small_finetuned.pth",),
    size=88_200_000,
    licence="MIT (code); weights: nothing separate stated, fine-tuned from DINOv2 (Apache-2.0)",
    file="dinov2_reg_small_finetuned.pth",
    check="droidw_plugins._vit.published:check_fit3d",
    reference="Yue et al., FiT3D, ECCV 2024; github.com/ywyue/FiT3D",
)

FIT3D_PLAIN = WeightsFile(
    name="fit3d-plain",
    urls=("https://huggingface.co/yuanwenyue/FiT3D/resolve/main/dinov2_small_finetuned.pth",),
    size=88_200_000,
    licence="MIT (code); weights: nothing separate stated, fine-tuned from DINOv2 (Apache-2.0)",
    file="dinov2_small_finetuned.pth",
    check="droidw_plugins._vit.published:check_fit3d_plain",
    reference="Yue et al., FiT3D, ECCV 2024; github.com/ywyue/FiT3D; without registers",
)

DINOV2_VITS14 = WeightsFile(
    name="dinov2-vits14",
    urls=("https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth",),
    size=88_200_000,
    licence="Apache-2.0",
    file="dinov2_vits14_pretrain.pth",
    check="droidw_plugins._vit.published:check_dinov2_vits14",
    reference="Oquab et al., DINOv2, TMLR 2024; github.com/facebookresearch/dinov2",
)

DINOV2_VITS14_REG = WeightsFile(
    name="dinov2-vits14-reg",
    urls=("https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_reg4_pretrain.pth",),
    size=88_200_000,
    licence="Apache-2.0",
    file="dinov2_vits14_reg4_pretrain.pth",
    check="droidw_plugins._vit.published:check_dinov2_vits14_reg",
    reference="Darcet et al., Vision Transformers Need Registers, ICLR 2024; same repository",
)

METRIC3D_VIT_SMALL = WeightsFile(
    name="metric3d-vit-small",
    urls=("https://huggingface.co/JUGGHM/Metric3D/resolve/main/metric_depth_vit_small_800k.pth",),
    size=150_000_000,
    licence="BSD-2-Clause (code); weights: nothing separate stated",
    file="metric_depth_vit_small_800k.pth",
    check="droidw_plugins.depth._metric3d_net:check_vit_small",
    reference="Hu et al., Metric3D v2, TPAMI 2024; github.com/YvanYin/Metric3D",
)

METRIC3D_VIT_LARGE = WeightsFile(
    name="metric3d-vit-large",
    urls=("https://huggingface.co/JUGGHM/Metric3D/resolve/main/metric_depth_vit_large_800k.pth",),
    size=1_648_000_000,
    licence="BSD-2-Clause (code); weights: nothing separate stated",
    file="metric_depth_vit_large_800k.pth",
    check="droidw_plugins.depth._metric3d_net:check_vit_large",
    reference="Hu et al., Metric3D v2, TPAMI 2024; github.com/YvanYin/Metric3D",
)
