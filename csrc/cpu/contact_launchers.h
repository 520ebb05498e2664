#pragma once

#include "boundary/obstacle.h"
#include "cpu/launchers.h"

namespace mpm::cpu {

template <class T, int D>
void contact(const ContactArguments<T, D>&, Stream);
template <class T, int D>
void contact_backward(const ContactArguments<T, D>&, Stream);

}  // namespace mpm::cpu
