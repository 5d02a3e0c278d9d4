function make_model(name)
% make_model  Builds the arms' side of the bridge as a Simulink subsystem around arm_side_block.
%
%   make_model            creates and opens the model tandem_arms
%   make_model('name')    creates and opens the model of that name
%
% Run it in the directory that contains arm_side.c and arm_side.h. It needs Simulink R2018b or later (C Caller block)
% and uses no block of QUARC. Then add QUARC's Stream Server block and the blocks that read and move your arms, and
% connect them as printed. docs/drivers.md, section QUARC, explains the rules and the settings.
%
% This script was written from the documentation and has never been run.

if nargin < 1
    name = 'tandem_arms';
end
sample_time = '0.01';
new_system(name);
set_param(name, 'SolverType', 'Fixed-step', 'Solver', 'FixedStepDiscrete', 'FixedStep', sample_time, ...
    'SimCustomHeaderCode', '#include "arm_side.h"', 'SimUserSources', 'arm_side.c', 'SimUserIncludeDirs', pwd, ...
    'SimParseCustomCode', 'on', 'CustomHeaderCode', '#include "arm_side.h"', 'CustomSource', 'arm_side.c', ...
    'CustomInclude', pwd);

side = [name '/Arms side'];
add_block('simulink/Ports & Subsystems/Subsystem', side);
delete_line(side, 'In1/1', 'Out1/1');
delete_block([side '/In1']);
delete_block([side '/Out1']);

caller = [side '/arm_side_block'];
add_block('simulink/User-Defined Functions/C Caller', caller);
set_param(caller, 'FunctionName', 'arm_side_block');
ports = get_param(caller, 'FunctionPortSpecification');
for k = 1:numel(ports.InputArguments)
    if any(strcmp(ports.InputArguments(k).Name, {'rates', 'openings', 'brake', 'state', 'send'}))
        ports.InputArguments(k).Scope = 'Output';
    end
end

% 1 in the first sample, then 0.
add_block('simulink/Sources/Constant', [side '/zero'], 'Value', '0', 'SampleTime', sample_time);
add_block('simulink/Discrete/Unit Delay', [side '/is first'], 'InitialCondition', '1');
add_line(side, 'zero/1', 'is first/1');
add_line(side, 'is first/1', 'arm_side_block/1');
add_block('simulink/Sources/Constant', [side '/sample time'], 'Value', sample_time, 'SampleTime', sample_time);
add_line(side, 'sample time/1', 'arm_side_block/2');
add_block('simulink/Sources/Digital Clock', [side '/stamp'], 'SampleTime', sample_time);
add_line(side, 'stamp/1', 'arm_side_block/3');

% The outputs of the Stream Server block, each through a unit delay: the block is also fed by this subsystem.
received = {'rcv', 'new', 'is connected', 'sent'};
widths = {'14', '1', '1', '1'};
for k = 1:numel(received)
    add_block('simulink/Sources/In1', [side '/' received{k}], 'PortDimensions', widths{k}, ...
        'OutDataTypeStr', 'double', 'SampleTime', sample_time);
    add_block('simulink/Discrete/Unit Delay', [side '/' received{k} ' before'], ...
        'InitialCondition', ['zeros(' widths{k} ',1)']);
    add_line(side, [received{k} '/1'], [received{k} ' before/1']);
    add_line(side, [received{k} ' before/1'], sprintf('arm_side_block/%d', 3 + k));
end
add_block('simulink/Sources/In1', [side '/readings'], 'PortDimensions', '34', 'OutDataTypeStr', 'double', ...
    'SampleTime', sample_time);
add_line(side, 'readings/1', 'arm_side_block/8');

sent = {'rates', 'openings', 'brake', 'snd', 'en'};
for k = 1:numel(sent)
    add_block('simulink/Sinks/Out1', [side '/' sent{k}]);
    add_line(side, sprintf('arm_side_block/%d', k), [sent{k} '/1']);
end
Simulink.BlockDiagram.arrangeSystem(side);
open_system(name);

fprintf(['Add QUARC''s Stream Server block (qc_open_library(''quarc_library/Communications/Basic'')):\n' ...
    '  URI tcpip://0.0.0.0:18000?nagle=''off'', sample time %s s, byte order little-endian,\n' ...
    '  default output value zeros(14,1), double; send buffer 304 bytes, receive buffer 112 bytes\n' ...
    'Connect its outputs rcv, new and sent to the inputs of these names, converted to double, and its output\n' ...
    'state, compared with "connected" (block Stream State Comparison), to the input "is connected".\n' ...
    'Connect the outputs snd and en to its inputs. Connect your arms to readings, rates, openings and brake:\n' ...
    'where brake is 1, they have to brake and hold their position, and grippers do not move.\n'], sample_time);
end
