"""The interfaces of other simulators on top of torch_mpm, so that their scripts run with another import.

- `torch_mpm.compat.physgaussian`: `MPM_Simulator_WARP` of PhysGaussian and its descendants, with JSON configurations.
- `torch_mpm.compat.warp_mpm`: `MPMWARPDiff` of PhysDreamer, with its structs.
- `torch_mpm.compat.taichi_elements`: `MPMSolver` of taichi_elements.
- `torch_mpm.compat.nclaw`: simulator and laws of NCLaw.
- `torch_mpm.compat.mpm_pytorch`: `MPMSolver`, constitutive models and boundary conditions of MPM-PyTorch;
  `MPMModel` of OmniPhysGS.

Names of arguments, units and the order of operations are those of the other simulator, as are names in CamelCase.
docs/migrating lists the differences.
"""
