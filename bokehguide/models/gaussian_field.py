"""The radiance field of highlight spots: isotropic 3D Gaussians (Eq. 18-20)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bokehguide.models.projection import lens_magnification
from bokehguide.render.camera import ThinLensCamera


class GaussianField(nn.Module):
    """G highlight spots in the camera frame, shared by all pixels.

    Buffers, set by a fit and not by gradients (section 4.2):
    mean: `[3, G]` metres; radius: R_b `[G]`, the bounding sphere of the spot's patch;
    sigma: `[G]` metres, α R_b; energy: `[G]`, radiance × projected area of the patch.
    """

    def __init__(self) -> None:
        super().__init__()
        for name, shape in (("mean", (3, 0)), ("radius", (0,)), ("sigma", (0,)), ("energy", (0,))):
            self.register_buffer(name, torch.zeros(shape))

    def __len__(self) -> int:
        return self.mean.shape[1]

    @torch.no_grad()
    def assign(self, mean: Tensor, radius: Tensor, sigma: Tensor, energy: Tensor) -> None:
        """Replace the whole set of Gaussians.

        Raises ValueError for a Gaussian that is not finite or has no extent or energy.
        """
        values = torch.cat((mean, radius[None], sigma[None], energy[None]))
        if not bool(values.isfinite().all()) or not bool((values[3:] > 0.0).all()):
            raise ValueError("Gaussians need finite means and positive radius, sigma and energy")
        device = self.mean.device
        self.mean, self.radius = mean.float().to(device), radius.float().to(device)
        self.sigma, self.energy = sigma.float().to(device), energy.float().to(device)

    def lens_weights(self, focus_distance: float) -> Tensor:
        """Unnormalised mixture weights `[G]`: the energy each spot sends through the lens.

        Its area as the lens shows it scales with k², so near spots count for more than
        Eq. 12-17 as printed would have it.
        """
        return self.energy * lens_magnification(self.mean[2], focus_distance).square()

    def footprints(self, camera: ThinLensCamera) -> tuple[Tensor, Tensor]:
        """Raster centres `[2, G]` and radii in pixels `[G]` of the discs outside which Eq. 22 culls.

        A Gaussian is kept if its projected mean lies within r + |k|σ of the lens centre. On
        the focal plane that is a disc of radius (r |Z - d_F| + σ d_F) / Z about the pinhole
        projection.
        """
        lens, depth = camera.lens, self.mean[2]
        radius = (lens.radius * (depth - lens.focus_distance).abs() + self.sigma * lens.focus_distance) / depth
        return camera.raster(self.mean), radius / (lens.focus_distance * camera.pixel_slope)

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs) -> None:
        for name in ("mean", "radius", "sigma", "energy"):  # a fit decides how many there are
            if prefix + name in state_dict:
                setattr(self, name, torch.empty_like(state_dict[prefix + name], device=self.mean.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
