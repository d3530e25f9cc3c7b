// Russian roulette.
#pragma once

// Where nothing absorbs, paths would never end by chance.
#define MAX_SURVIVAL 0.999f
