"""Files of frames under the names of PhysGaussian's `engine_utils`."""

import inspect

import numpy as np
import pytest
import torch

from torch_mpm.compat import physgaussian
from torch_mpm.compat.physgaussian import BatchedSimulator, MPM_Simulator_WARP
from torch_mpm.geometry import point_files

HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\n" + b"".join(
    b"property float %c\n" % axis for axis in b"xyz"
)
ARGUMENTS = {
    "save_data_at_frame": "mpm_solver dir_name frame save_to_ply save_to_h5",
    "particle_position_to_ply": "mpm_solver filename",
    "particle_position_tensor_to_ply": "position_tensor filename",
}


def moving():
    """A simulator after a few substeps, and its positions [P, 3]."""
    x = 0.4 + 0.2 * torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    sim = MPM_Simulator_WARP(10)
    sim.load_initial_data_from_torch(x, torch.full((30,), 1e-5), n_grid=20)
    sim.import_particle_v_from_torch(x - 0.5)
    sim.set_parameters_dict({"E": 1e4, "nu": 0.3, "density": 200.0})
    sim.finalize_mu_lam()
    for k in range(3):
        sim.p2g2p(k, 1e-3)
    return sim


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments(name):
    assert list(inspect.signature(getattr(physgaussian, name)).parameters) == ARGUMENTS[name].split()


def test_a_frame(tmp_path):
    """Both files, in the layout of the originals: fields as columns of particles."""
    h5py = pytest.importorskip("h5py")
    sim = moving()
    physgaussian.save_data_at_frame(sim, tmp_path / "new" / "simulation_ply", 12, save_to_h5=True)
    folder = tmp_path / "new" / "simulation_ply"
    assert sorted(path.name for path in folder.iterdir()) == ["sim_0000000012.h5", "sim_0000000012.ply"]
    content = (folder / "sim_0000000012.ply").read_bytes()
    x = sim.export_particle_x_to_torch().numpy()
    assert content == HEADER % 30 + b"end_header\n" + x.astype("<f4").tobytes()
    with h5py.File(folder / "sim_0000000012.h5") as file:
        assert {name: file[name].shape for name in file} == {
            **{"x": (3, 30), "v": (3, 30), "f_tensor": (9, 30), "C": (9, 30), "time": (1, 1)}
        }
        assert file["time"][0, 0] == pytest.approx(3e-3)
        for name, expected in (("v", sim.export_particle_v_to_torch()), ("C", sim.export_particle_C_to_torch()),
                               ("f_tensor", sim.export_particle_F_to_torch())):  # fmt: skip
            np.testing.assert_allclose(file[name][()].T, expected.numpy(), rtol=1e-6)
    physgaussian.save_data_at_frame(sim, str(tmp_path), 0, save_to_ply=False)
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_positions_of_a_tensor(tmp_path):
    x = torch.rand(5, 3, dtype=torch.float64, requires_grad=True)
    physgaussian.particle_position_tensor_to_ply(x, str(tmp_path / "points.ply"))
    found = point_files.read(tmp_path / "points.ply", 3)
    np.testing.assert_array_equal(found.x, x.detach().float().double().numpy())
    with pytest.raises(ValueError, match=r"position_tensor must have shape \[P, 3\], got \[5, 2\]"):
        physgaussian.particle_position_tensor_to_ply(x[:, :2], tmp_path / "other.ply")
    with pytest.raises(OSError, match="missing"):
        physgaussian.particle_position_tensor_to_ply(x, tmp_path / "missing" / "other.ply")


def test_a_batch_beside_each_other(tmp_path):
    """Scenes are displaced in the PLY file, and the HDF5 file has the first one, as in kywind's warp-mpm."""
    h5py = pytest.importorskip("h5py")
    x = 0.4 + 0.2 * torch.rand(2, 6, 3)
    sim = BatchedSimulator()
    sim.load_initial_data_from_torch(x, torch.full((2, 6), 1e-5), batch_size=2, dx=0.05)
    physgaussian.save_data_at_frame(sim, tmp_path, 0, save_to_h5=True)
    found = point_files.read(tmp_path / "sim_0000000000.ply", 3).x.reshape(2, 6, 3)
    np.testing.assert_allclose(
        found - x.numpy(), np.eye(3)[0] * np.arange(2)[:, None, None] + np.zeros((2, 6, 3)), atol=1e-6
    )
    with h5py.File(tmp_path / "sim_0000000000.h5") as file:
        np.testing.assert_array_equal(file["x"][()], x[0].T.numpy())
        assert file["f_tensor"].shape == (9, 6)
    assert float(sim.mpm_state.particle_x.amax()) < 1  # The simulator is unchanged.
