#pragma once

#include "boundary/obstacle.h"
#include "cuda/launchers.h"

namespace mpm::cuda {

template <class T, int D>
void contact(const ContactArguments<T, D>&, Stream);
template <class T, int D>
void contact_backward(const ContactArguments<T, D>&, Stream);

}  // namespace mpm::cuda
