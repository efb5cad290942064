// SPDX-License-Identifier: Apache-2.0
#pragma once
#include "splatbot/arm_kernels.hpp"
