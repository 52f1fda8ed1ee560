"""The radiance field of highlights: isotropic 3D Gaussians (Eq. 18-20)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bokehguide.models.projection import lens_magnification
from bokehguide.render.camera import ThinLensCamera


class GaussianField(nn.Module):
    """G highlights in the camera frame, common to all pixels. A fit sets the buffers (section 4.2).

    mean: `[3, G]`, metres. radius: R_b, radius of the sphere around the highlight's patch, `[G]`, metres. sigma: α R_b, `[G]`,
    metres. energy: radiance times projected area of the patch, up to a factor that all have in common, `[G]`.
    """

    mean: Tensor
    radius: Tensor
    sigma: Tensor
    energy: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name, shape in (("mean", (3, 0)), ("radius", (0,)), ("sigma", (0,)), ("energy", (0,))):
            self.register_buffer(name, torch.zeros(shape))

    def __len__(self) -> int:
        return self.mean.shape[1]

    @torch.no_grad()
    def assign(self, mean: Tensor, radius: Tensor, sigma: Tensor, energy: Tensor) -> None:
        """Replace all Gaussians by G others: means `[3, G]`; radii, sigmas and energies `[G]`; units as in the class.

        Raises ValueError for a Gaussian that is not finite, and for a Gaussian without extent or energy.
        """
        values = torch.cat((mean, radius[None], sigma[None], energy[None]))
        if not bool(values.isfinite().all()) or not bool((values[3:] > 0.0).all()):
            raise ValueError("Gaussians need finite means and positive radius, sigma and energy")
        device = self.mean.device
        self.mean, self.radius = mean.float().to(device), radius.float().to(device)
        self.sigma, self.energy = sigma.float().to(device), energy.float().to(device)

    def lens_weights(self, focus_distance: float) -> Tensor:
        """Unnormalised mixture weights `[G]`: the energy that each highlight sends through the lens.

        The area of a highlight on the lens is proportional to k². The printed Eq. 12-17 omit this factor.
        """
        return self.energy * lens_magnification(self.mean[2], focus_distance).square()

    def footprints(self, camera: ThinLensCamera) -> tuple[Tensor, Tensor]:
        """Discs of the pixels that have each Gaussian as a candidate (Eq. 22): centres `[2, G]` on the raster, radii `[G]` in
        pixels.

        A Gaussian is a candidate of a pixel if its projected mean lies within r + |k|σ of the lens centre. The focus points of
        these pixels form a disc of radius (r |Z - d_F| + σ d_F) / Z about the pinhole projection of the mean.
        """
        lens, depth = camera.lens, self.mean[2]
        radius = (lens.radius * (depth - lens.focus_distance).abs() + self.sigma * lens.focus_distance) / depth
        return camera.raster(self.mean), radius / (lens.focus_distance * camera.pixel_slope)

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        for name in ("mean", "radius", "sigma", "energy"):  # the number of Gaussians varies
            if prefix + name in state_dict:
                setattr(self, name, torch.empty_like(state_dict[prefix + name], device=self.mean.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
