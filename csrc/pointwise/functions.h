#pragma once

#include <tuple>

#include "pointwise/thermal.h"

// All functions of a row, by their numbers.
namespace mpm {
inline namespace TORCH_MPM_ISA {

using PointwiseFunctions = std::tuple<HeatWeightsOfParticle, HeatMoments<1>, HeatMoments<2>, HeatMeans<1>, HeatMeans<2>,
                                      HeatUpdate<1>, HeatUpdate<2>, HeatMelt, HeatLayer, HeatExchange, HeatRadiation,
                                      SurfaceNormals, Length, BoxDistance, ThermalStretch, MeltingParts, MeltingStress>;

// f.operator()<Function>() of function number k.
template <int First = 0, class F>
void with_function(int k, const F& f) {
  if constexpr (First < int(std::tuple_size_v<PointwiseFunctions>)) {
    if (k == First)
      f.template operator()<std::tuple_element_t<First, PointwiseFunctions>>();
    else
      with_function<First + 1>(k, f);
  }
}

}  // namespace TORCH_MPM_ISA
}  // namespace mpm
