# Completes the words of swarmjax in fish. Written by: swarmjax --completion fish

set -g __swarmjax_commands '@COMMANDS@'

set -g __swarmjax_table '@TABLE@'

# Prints the next part, up to the next dot, of each key of command $argv[1] that begins with $argv[2].
function __swarmjax_keys
    set -l size (string length -- "$argv[2]")
    for line in (string split \n -- $__swarmjax_table)
        set -l words (string split ' ' -- $line)
        test "$words[1]" = "$argv[1]"; or continue
        test (string sub -l $size -- "$words[2]") = "$argv[2]"; or continue
        set -l rest (string sub -s (math $size + 1) -- $words[2])
        if string match -q '*.*' -- $rest
            echo $argv[2](string split -m 1 . -- $rest)[1].
        else
            echo $words[2]=
        end
    end
end

# Prints the values of key $argv[2] of command $argv[1] that begin with $argv[3].
function __swarmjax_values
    for line in (string split \n -- $__swarmjax_table)
        set -l words (string split ' ' -- $line)
        test "$words[1]" = "$argv[1]" -a "$words[2]" = "$argv[2]"; or continue
        for value in $words[3..-1]
            if test $value = @file
                printf "$argv[2]=%s\n" (__fish_complete_path "$argv[3]")
            else
                echo "$argv[2]=$value"
            end
        end
    end
end

function __swarmjax_words
    set -l command (commandline -opc)[2]
    set -l word (commandline -ct)
    if string match -q '*=*' -- $word
        set -l parts (string split -m 1 = -- $word)
        __swarmjax_values $command $parts[1] "$parts[2]"
    else
        __swarmjax_keys $command "$word"
    end
end

complete -c swarmjax -f
for line in (string split \n -- $__swarmjax_commands)
    set -l parts (string split -m 1 ' ' -- $line)
    complete -c swarmjax -n __fish_is_first_token -a $parts[1] -d $parts[2]
end
complete -c swarmjax -n __fish_is_first_token -l version -d 'Versions of swarmjax, JAX and MuJoCo'
complete -c swarmjax -n __fish_is_first_token -l completion -xa 'bash zsh fish'
complete -c swarmjax -l help -d 'Examples and keys'
complete -c swarmjax -n 'not __fish_is_first_token' -a '(__swarmjax_words)'
